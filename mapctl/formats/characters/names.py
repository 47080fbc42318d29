"""Names of joints and armatures, made unique: files of characters need not have them so."""

from mapctl.isolated.naming import make_unique

__all__ = ["make_unique"]
