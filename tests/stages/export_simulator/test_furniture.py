"""Movable furniture of the page: what can be moved, and that paths avoid it."""

from typing import Any

import numpy as np

from pipeline.behavior.support import mark_supported
from tests.stages.export_simulator.test_support_twins import SOURCES, needs_node, run_node

pytestmark = needs_node
SHAPE, VOXEL_M = (40, 24, 40), 0.1
LEVEL, BAND = 2, [2, 4]
VOLUME = {"shape": [2, *SHAPE], "origin": [-2.0, -0.2, -2.0], "voxel_m": VOXEL_M}
ASK = f"""
import {{ Detour }} from '{SOURCES}/detour.js';
import {{ Furniture, arranged, movedFeatures, sameCells, Grid }} from '{SOURCES}/furniture.js';
const asked = JSON.parse(await new Response(process.stdin).text());
const [occupancy, allowed] = [asked.occupancy, asked.allowed].map((values) => Uint8Array.from(values));
const home = new Furniture(asked.volume, occupancy, allowed, 0);
const moves = (asked.moves ?? []).map(([point, by]) => {{
  const {{ piece }} = home.find(point);
  return {{ piece, cells: piece.all, by }};
}});
const answers = {{
  found: () => asked.points.map((point) => {{
    const {{ piece, reason }} = home.find(point);
    return piece ? piece.cells : reason;
  }}),
  refusals: () => asked.tries.map(([by, bodies]) =>
    home.refusal(home.find(asked.points[0]).piece, by, moves, bodies, 0.25)),
  arranged: () => {{
    const after = arranged(home, moves);
    return {{
      occupancy: Array.from(after.occupancy),
      allowed: Array.from(after.allowed),
      same: [after.occupancy === occupancy, after.allowed === allowed],
      kept: [Array.from(home.occupancy), Array.from(home.allowed)],
    }};
  }},
  features: () => Array.from(movedFeatures(Float32Array.from(asked.values), home.grid, moves)),
  led: () => {{
    const detour = new Detour(asked.volume, arranged(home, moves).allowed, moves, {BAND});
    return asked.paths.map((path) => detour.halted(detour.lead(path.slice(1), path[0]), path[0]));
  }},
  elsewhere: () => sameCells(moves[0].cells, home.grid, new Grid(asked.other)),
}};
console.log(JSON.stringify({{ answer: answers[asked.question]() }}));
"""


def home() -> np.ndarray:
    """Floor, four walls, a box in the middle, a table on four legs, a bench at a wall, a shelf on a wall, a
    counter of 3.2 m.
    """
    solid = np.zeros(SHAPE, np.uint8)
    solid[:, :LEVEL] = 1
    solid[[0, -1]] = solid[:, :, [0, -1]] = 1
    solid[17:22, LEVEL:9, 18:23] = 1
    solid[28:35, 7, 28:35] = 1
    for x, z in ((28, 28), (28, 34), (34, 28), (34, 34)):
        solid[x, LEVEL:8, z] = 1
    solid[1:4, LEVEL:6, 8:14] = 1
    solid[1:3, 14, 25:30] = 1
    solid[5:37, LEVEL:11, 4:6] = 1
    return solid


BOX = [-0.05, 0.75, 0.05]
TABLE = [1.1, 0.6, 1.1]
BENCH = [-1.75, 0.4, -0.9]
WALL = [-1.95, 1.0, 1.8]
SHELF = [-1.8, 1.25, 0.75]
COUNTER = [0.0, 0.9, -1.5]
FLOOR = [1.5, 0.0, -0.5]


def asked(question: str, **more: Any) -> Any:
    """Return the answer of the page about the home."""
    solid = home()
    marks = mark_supported(solid == 0, solid)
    grids = {"volume": VOLUME, "occupancy": solid.ravel().tolist(), "allowed": marks.ravel().tolist()} | more
    return run_node(ASK, question=question, **grids).item()["answer"]


def test_only_free_standing_furniture_is_movable() -> None:
    found = asked("found", points=[BOX, TABLE, BENCH, WALL, SHELF, COUNTER, FLOOR])
    solid = home()
    for points, cells in (
        ((17, 22, 18, 23), found[0]),
        ((28, 35, 28, 35), found[1]),
        ((1, 4, 8, 14), found[2]),
    ):
        part = np.zeros(SHAPE, bool)
        part[points[0] : points[1], LEVEL:, points[2] : points[3]] = True
        assert sorted(cells) == np.flatnonzero(part & (solid == 1)).tolist()
    assert "wall" in found[3] and "hanging" in found[4]
    assert found[5] == "This is too large to move: 3.2 m."
    assert "Nothing stands here" in found[6]


def test_occupancy_and_support_move_with_the_furniture() -> None:
    solid = home()
    box = solid.copy()
    box[17:22, LEVEL:9, 18:23] = 0
    moved = box.copy()
    moved[24:29, LEVEL:9, 14:19] = 1
    after = asked("arranged", moves=[(BOX, [7, -4])])
    np.testing.assert_array_equal(np.reshape(after["occupancy"], SHAPE), moved)
    np.testing.assert_array_equal(np.reshape(after["allowed"], SHAPE), mark_supported(moved == 0, moved))
    assert (moved == 1).sum() == (solid == 1).sum()
    back = asked("arranged", moves=[])
    assert back["same"] == [True, True], "the very arrays that were recorded"
    for state in (after, back):
        assert state["kept"] == [back["occupancy"], back["allowed"]]


def test_unobserved_space_moves_with_the_furniture() -> None:
    """The unobserved space below a table becomes free floor when the table is moved."""
    solid = home()
    solid[29:34, :7, 29:34] = 2
    marks = mark_supported(solid == 0, solid)
    grids = {"occupancy": solid.ravel().tolist(), "allowed": marks.ravel().tolist()}
    after = {
        key: np.reshape(value, SHAPE)
        for key, value in asked("arranged", moves=[(TABLE, [-3, -12])], **grids).items()
        if key in ("occupancy", "allowed")
    }
    assert (after["occupancy"][26:31, LEVEL:7, 17:22] == 2).all()
    assert (after["allowed"][26:31, LEVEL:7, 17:22] == 0).all()
    assert (after["occupancy"][29:34, LEVEL:7, 29:34] == 0).all()
    assert (after["allowed"][29:34, LEVEL, 29:34] == 3).all(), "as floor that was filled"


def test_features_move_with_the_furniture() -> None:
    values = np.random.default_rng(0).normal(size=(2, *SHAPE)).astype(np.float32)
    moved = np.reshape(
        asked("features", moves=[(BOX, [7, -4])], values=values.ravel().tolist()), values.shape
    )
    expected = values.copy()
    expected[:, 17:22, LEVEL:9, 18:23] = 0
    expected[:, 24:29, LEVEL:9, 14:19] = values[:, 17:22, LEVEL:9, 18:23]
    np.testing.assert_array_equal(moved.astype(np.float32), expected)


def test_furniture_is_placed_only_on_free_floor() -> None:
    nobody: list[dict[str, Any]] = []
    cat = [{"name": "cat is", "place": [0.8, 0.0]}]
    tries = [
        ([7, 0], nobody),
        ([7, 0], cat),
        ([12, 12], nobody),
        ([-19, 0], nobody),
        ([40, 0], nobody),
        ([0, 0], nobody),
    ]
    free, there, table, wall, outside, same = asked("refusals", points=[BOX], tries=tries)
    assert free is None and same is None
    assert there == "cat is in the way."
    assert table == wall == "Something else stands there."
    assert outside == "There is no floor to stand on."
    onto_bench = asked("refusals", points=[BOX], tries=[([10, 0], nobody)], moves=[(BENCH, [27, 10])])
    assert onto_bench == ["Something else stands there."], "where that has been moved to"


def test_paths_avoid_moved_furniture() -> None:
    """Straight paths at 0.4 m/s through the new position, from all sides."""
    rng = np.random.default_rng(0)
    middle = np.array([0.65, -0.35])
    angle, aside = rng.uniform(0, 2 * np.pi, 40), rng.uniform(-0.2, 0.2, 40)
    along = np.linspace(-0.95, 0.95, 57)
    way, side = np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)
    flat = middle + along[:, None] * way[:, None] + aside[:, None, None] * side[:, None]
    paths = np.stack([flat[..., 0], np.full(flat.shape[:2], 0.12), flat[..., 1]], -1)
    moves = [(BOX, [7, -4])]
    moved = mask_of_box(7, -4)
    assert entered(paths, moved).all()
    assert not entered(paths, home()[:, LEVEL:5].any(1) & ~mask_of_box(0, 0)).any(), "free of all that stays"
    free = np.array(asked("led", moves=[(BENCH, [0, 1])], paths=paths.tolist()))
    np.testing.assert_array_equal(free, paths[:, 1:])
    led = np.array(asked("led", moves=moves, paths=paths.tolist()))
    whole = np.concatenate([paths[:, :1], led], axis=1)
    assert not entered(whole, moved).any()
    steps = np.linalg.norm(np.diff(whole, axis=1), axis=-1)
    assert steps.max() < 1.21 * 1.9 / 56, "meters in 0.1 s: a walk, no jump"
    short = np.linalg.norm(whole[:, -1] - paths[:, -1], axis=-1)
    assert np.median(short) < 0.05 and short.max() < 0.4, "meters: what is left is for the next plan"


def mask_of_box(da: int, dc: int) -> np.ndarray:
    """Return the columns that the box occupies after a move."""
    mask = np.zeros((SHAPE[0], SHAPE[2]), bool)
    mask[17 + da : 22 + da, 18 + dc : 23 + dc] = True
    return mask


def entered(paths: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return which paths, sampled every half centimeter, enter one of the columns."""
    share = np.linspace(0, 1, 10, endpoint=False)[:, None, None, None]
    dense = paths[:, :-1] * (1 - share) + paths[:, 1:] * share
    at = np.floor((dense[..., [0, 2]] + 2.0) / VOXEL_M + 1e-6).astype(int)
    return columns[at[..., 0], at[..., 1]].any((0, 2))


def test_grid_resampling_preserves_space() -> None:
    other = {"shape": [2, 30, 24, 40], "origin": [-1.0, -0.2, -2.0], "voxel_m": VOXEL_M}
    cells = asked("elsewhere", moves=[(BOX, [0, 0])], other=other)
    part = np.zeros((30, 24, 40), bool)
    part[7:12, LEVEL:9, 18:23] = True
    assert sorted(cells) == np.flatnonzero(part).tolist()
