"""A body is placed by its picture alone: its outline, its colors, and what hides it."""

import cv2
import numpy as np
import trimesh

from pipeline.geometry import picture_fit, rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

SIZE = (160, 120)
INTRINSICS = np.array([[130.0, 0, 60], [0, 130.0, 80], [0, 0, 1]])
UP = np.array([0.0, 1.0, 0.0])
EYE = np.array([0.3, 1.1, 1.7])
CAMERA = rigid.look_at(EYE, np.array([0.0, 0.2, 0.0]), UP)
LENGTH_M = 0.5
TRUTH = rigid.make(rigid.rotation_from_vector(0.7 * UP), np.array([0.05, 0.22, -0.04]))


def body() -> Mesh:
    """A box with a head: dark front, light back."""
    parts = [((0.15, 0.2, 0.45), (0, 0, 0)), ((0.12, 0.12, 0.14), (0, 0.14, 0.22))]
    boxes = [trimesh.creation.box(size, rigid.make(np.eye(3), np.array(at, float))) for size, at in parts]
    whole = trimesh.util.concatenate(boxes)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.03, max_iter=10)
    shade = np.clip(128 - 250 * vertices[:, 2], 20, 235).astype(np.uint8)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.repeat(shade[:, None], 3, axis=1))


def picture_of(
    pose: np.ndarray, brighter: int = 0, hidden: np.ndarray | None = None
) -> picture_fit.BodyPicture:
    """Draw the body in front of green; ``hidden`` is covered by something near."""
    mesh = body()
    depth, hits = render_view(RayCaster(mesh), rigid.inverse(pose) @ CAMERA, INTRINSICS, *SIZE)
    inside, near = depth > 0, np.zeros(SIZE, bool) if hidden is None else hidden
    shade = hits.interpolate(mesh, mesh.color).reshape(*SIZE, 3) + brighter
    color = np.where(inside[..., None], np.clip(shade, 0, 255), [60, 160, 80]).astype(np.uint8)
    mask = np.where(inside & ~near, 255, 0).astype(np.uint8)
    around = np.where(near, 0.5, 5.0).astype(np.float32)
    return picture_fit.body_picture(color, mask, cv2.resize(around, (60, 80)), INTRINSICS, CAMERA)


def turned(pose: np.ndarray, degrees: float) -> np.ndarray:
    return rigid.make(pose[:3, :3] @ rigid.rotation_from_vector(np.deg2rad(degrees) * UP), pose[:3, 3])


def test_pose_is_found_from_outline_and_colors():
    picture, colored = picture_of(TRUTH), picture_fit.colored_body(body())
    start = rigid.make(turned(TRUTH, 20)[:3, :3], TRUTH[:3, 3] + [0.05, 0.02, -0.06])
    found = picture_fit.search(start, lambda pose: colored.misfit(picture, pose), EYE, LENGTH_M)
    assert np.rad2deg(rigid.rotation_angle(found[:3, :3], TRUTH[:3, :3])) < 10, "degrees, of 20"
    assert np.linalg.norm(found[:3, 3] - TRUTH[:3, 3]) < 0.04, "meters, of 0.08"


def test_front_and_back_differ_by_color_where_outlines_agree():
    picture, colored = picture_of(TRUTH), picture_fit.colored_body(body())
    (outline, color), (other_outline, other_color) = (
        picture_fit.residuals(picture, colored, pose) for pose in (TRUTH, turned(TRUTH, 180))
    )
    assert outline < 0.1 and color < 6
    assert other_outline < 0.4, "a box has nearly the same outline from behind"
    assert other_color > 5 * color


def test_exposure_and_noise_of_a_recording_are_learned():
    poses = np.stack([turned(TRUTH, angle) for angle in (0, 80, 160, 240)])
    brighter = [picture_of(pose, 20) for pose in poses]
    plain = picture_fit.colored_body(body())
    learned = picture_fit.calibrated(plain, brighter, poses)
    assert 10 < learned.exposure[0] < 30, "gray values are 20 brighter, lightness of dark ones by more"
    before, after = (picture_fit.residuals(brighter[0], each, poses[0])[1] for each in (plain, learned))
    assert after < before / 2
    rough = picture_fit.calibrated(plain, brighter, np.stack([turned(pose, 25) for pose in poses]))
    assert (rough.typical > learned.typical).all(), "rough poses have larger residuals"


def test_what_hides_the_body_is_no_misfit():
    hidden = np.zeros(SIZE, bool)
    hidden[:, :55] = True
    colored = picture_fit.colored_body(body())
    assert picture_fit.residuals(picture_of(TRUTH, hidden=hidden), colored, TRUTH)[0] < 0.15
    away = rigid.make(TRUTH[:3, :3], TRUTH[:3, 3] + [0.2, 0, 0])
    assert picture_fit.residuals(picture_of(TRUTH, hidden=hidden), colored, away)[0] > 0.4
