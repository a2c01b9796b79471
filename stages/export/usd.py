"""Universal Scene Description: the animal as SkelRoot with a SkelAnimation per motion, the room as a mesh."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pipeline.data import images
from pipeline.data.glb import Action
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from stages.export.reading import Agent
from stages.export.writing import ExportRecord, extra, version

_ROOT = "root"


def write(folder: Path, agent: Agent, room: Mesh) -> ExportRecord:
    """Write `agent_<motion>.usdc`, one per motion, and `scene.usdc`."""
    modules = ("Gf", "Usd", "UsdGeom", "UsdSkel", "Vt")
    pxr = SimpleNamespace(**{name: extra(f"pxr.{name}", "usd-core") for name in modules})
    worst_mm = 0.0
    for action in agent.actions:
        path = folder / f"agent_{action.name}.usdc"
        _write_agent(pxr, path, agent, action)
        worst_mm = max(worst_mm, _opened(pxr, path, action) * 1000)
    stage = _stage(pxr, folder / "scene.usdc")
    stage.SetDefaultPrim(_mesh(pxr, stage, "/scene", room).GetPrim())
    stage.Save()
    library, loss = version("usd-core"), agent.loss_mm | {"joints": round(worst_mm, 4)}
    return ExportRecord(library, loss, f"UsdSkel of {library}", "meters, +y up, time codes in frames")


def _stage(pxr: Any, path: Path) -> Any:
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def _mesh(pxr: Any, stage: Any, path: str, mesh: Mesh) -> Any:
    surface = pxr.UsdGeom.Mesh.Define(stage, path)
    points = mesh.vertices.astype(np.float32)
    surface.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    surface.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(mesh.faces.reshape(-1).astype(np.int32)))
    surface.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    surface.CreateSubdivisionSchemeAttr("none")
    surface.CreateDoubleSidedAttr(True)
    if mesh.color is not None:
        linear = images.linear_from_srgb(mesh.color / 255)
        shown = surface.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
        shown.Set(pxr.Vt.Vec3fArray.FromNumpy(linear.astype(np.float32)))
    return surface


def _write_agent(pxr: Any, path: Path, agent: Agent, action: Action) -> None:
    """One root joint carries `world_from_agent`; the bones are its children."""
    stage = _stage(pxr, path)
    stage.SetTimeCodesPerSecond(agent.rate_hz)
    stage.SetFramesPerSecond(agent.rate_hz)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(action.time_s) - 1)
    root = pxr.UsdSkel.Root.Define(stage, "/agent")
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = pxr.UsdSkel.Skeleton.Define(stage, "/agent/skeleton")
    joints = [_ROOT, *(f"{_ROOT}/{name}" for name in agent.skin.bone_names)]
    rest = np.concatenate([np.eye(4)[None], agent.skin.agent_from_bone_rest])
    matrices = [pxr.Gf.Matrix4d(*matrix.T.astype(float).ravel()) for matrix in rest]  # rows are columns there
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(matrices)
    skeleton.CreateRestTransformsAttr(matrices)
    surface = _mesh(pxr, stage, "/agent/surface", agent.mesh)
    binding = pxr.UsdSkel.BindingAPI.Apply(surface.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    influences = agent.skin.joints.shape[1]
    bones = pxr.Vt.IntArray.FromNumpy(agent.skin.joints.reshape(-1).astype(np.int32) + 1)
    weights = pxr.Vt.FloatArray.FromNumpy(agent.skin.weights.reshape(-1).astype(np.float32))
    binding.CreateJointIndicesPrimvar(False, influences).Set(bones)
    binding.CreateJointWeightsPrimvar(False, influences).Set(weights)
    binding.CreateGeomBindTransformAttr(pxr.Gf.Matrix4d(1))
    animation = pxr.UsdSkel.Animation.Define(stage, "/agent/motion")
    _keys(pxr, animation, joints, action)
    animated = pxr.UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel()
    animated.SetTargets([animation.GetPath()])
    stage.Save()


def _keys(pxr: Any, animation: Any, joints: list[str], action: Action) -> None:
    poses = np.concatenate([action.world_from_agent[:, None], action.agent_from_bone], axis=1)
    turns = rigid.quaternion_from_rotation(poses[..., :3, :3].astype(np.float64))
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr([pxr.Gf.Vec3h(1, 1, 1)] * len(joints))
    places, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    for frame in range(len(poses)):
        place = np.ascontiguousarray(poses[frame, :, :3, 3], np.float32)
        places.Set(pxr.Vt.Vec3fArray.FromNumpy(place), frame)
        rotations.Set(pxr.Vt.QuatfArray([pxr.Gf.Quatf(*map(float, turn)) for turn in turns[frame]]), frame)


def _opened(pxr: Any, path: Path, action: Action) -> float:
    """Open the file and return the largest error of joint positions in one pose, meters."""
    stage = pxr.Usd.Stage.Open(str(path))
    cache = pxr.UsdSkel.Cache()
    cache.Populate(pxr.UsdSkel.Root(stage.GetPrimAtPath("/agent")), pxr.Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(pxr.UsdSkel.Skeleton(stage.GetPrimAtPath("/agent/skeleton")))
    frame = len(action.time_s) // 2
    found = np.array([np.array(matrix).T for matrix in query.ComputeJointSkelTransforms(frame)])[1:]
    expected = action.world_from_agent[frame] @ action.agent_from_bone[frame]
    return float(np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1).max())
