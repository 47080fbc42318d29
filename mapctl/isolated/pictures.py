"""Pictures of materials, read where a vertex lies in them, and the two ways of telling a colour."""

import io

import numpy as np

Array = np.ndarray
_MAX_PIXELS = 2**26


def encode_srgb(linear: Array) -> Array:
    """Return sRGB of colours that are in proportion to light, 0 to 1."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Array) -> Array:
    """Undo `encode_srgb`."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def decode_picture(data: bytes) -> Array | None:
    """Return a picture's pixels (height, width, 4), 0 to 255; None without the package pillow, for kinds that it does
    not know, and for pictures that are broken or huge."""
    try:
        from PIL import Image
    except ImportError:  # the extra `render` is not installed, and nothing will be drawn
        return None
    try:
        with Image.open(io.BytesIO(data)) as opened:
            if opened.width * opened.height > _MAX_PIXELS:
                return None
            return np.asarray(opened.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def sample_picture(picture: Array, where: Array) -> Array:
    """Return the picture's colours (n, 4), sRGB and opacity, 0 to 1, at places (n, 2): from its upper left corner, 1 at
    the other sides, and repeated beyond."""
    height, width = picture.shape[:2]
    column = np.floor(np.mod(where[:, 0], 1.0) * width).astype(int).clip(0, width - 1)
    row = np.floor(np.mod(where[:, 1], 1.0) * height).astype(int).clip(0, height - 1)
    return picture[row, column] / 255.0
