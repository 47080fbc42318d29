"""USD files as usd-core sees them: joints, skinned vertices, and what its own checks say."""

from os import PathLike

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel, UsdValidation


class UsdViewer:
    """A stage, its skeletons and meshes posed by UsdSkel."""

    def __init__(self, path: str | PathLike[str], number: int = 0):
        self.stage = Usd.Stage.Open(str(path))
        self.prims = list(Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()))
        self.skeleton = [prim for prim in self.prims if prim.IsA(UsdSkel.Skeleton)][number]
        root = UsdSkel.Root.Find(self.skeleton)
        self.cache = UsdSkel.Cache()
        self.cache.Populate(root, Usd.TraverseInstanceProxies())
        self.query = self.cache.GetSkelQuery(UsdSkel.Skeleton(self.skeleton))
        bindings = self.cache.ComputeSkelBindings(root, Usd.TraverseInstanceProxies())
        self.meshes = [
            mesh
            for binding in bindings
            if binding.GetSkeleton().GetPrim() == self.skeleton
            for mesh in binding.GetSkinningTargets()
        ]

    def joints(self, time: float) -> np.ndarray:
        """(joints, 3) in a world of metres and Y up."""
        return self._to_world(np.array(self.query.ComputeJointSkelTransforms(time))[:, 3, :3], time)

    def vertices(self, time: float) -> np.ndarray:
        """(n, 3) of all meshes of the skeleton, skinned."""
        found = []
        for mesh in self.meshes:
            points = mesh.GetPrim().GetAttribute("points").Get()
            assert mesh.ComputeSkinnedPoints(self.query.ComputeSkinningTransforms(time), points, time)
            found.append(self._to_world(np.array(points), time))
        return np.concatenate(found)

    def times(self, fps: float) -> np.ndarray:
        """Time codes of the frames of the stage's range."""
        first, last = self.stage.GetStartTimeCode(), self.stage.GetEndTimeCode()
        step = self.stage.GetTimeCodesPerSecond() / fps
        return first + step * np.arange(round((last - first) / step) + 1)

    def _to_world(self, positions: np.ndarray, time: float) -> np.ndarray:
        matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(self.skeleton))
        found = (positions @ matrix[:3, :3] + matrix[3, :3]) * UsdGeom.GetStageMetersPerUnit(self.stage)
        if UsdGeom.GetStageUpAxis(self.stage) == "Z":
            return np.stack([found[:, 0], found[:, 2], -found[:, 1]], axis=1)
        return found


def find_faults(path: str | PathLike[str]) -> list[str]:
    """Messages of usdchecker's validators on a file, each once."""
    registry = UsdValidation.ValidationRegistry()
    names = [given.name for given in registry.GetAllValidatorMetadata() if not given.isSuite]
    context = UsdValidation.ValidationContext([registry.GetOrLoadValidatorByName(name) for name in names])
    return sorted({error.GetName() for error in context.Validate(Usd.Stage.Open(str(path)))})
