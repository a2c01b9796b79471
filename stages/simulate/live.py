"""Live view in a browser, computed on this machine (viser, an extra): for networks too large for a page.

The server listens on the loopback interface and answers only its own page. One visitor drags the person;
`run` continues until stopped or interrupted, and returns the take.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from http import HTTPStatus
from threading import Event
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.behavior.config import MAX_GUIDANCE
from pipeline.behavior.simulator import Simulator, SimulatorState
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.core import loopback
from pipeline.core.errors import InputError
from pipeline.data.glb import Skin
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from stages.simulate.rollout import Take, take_of

PERSON, GOAL, FUR = (47, 111, 159), (200, 114, 43), (150, 120, 90)
"""Colors; the last of an animal that has none."""
PERSON_M, GOAL_M = 0.12, 0.06
"""Radii of the balls that show the person and the goal."""
SLIDER_STEP = 0.05


@dataclass(frozen=True)
class LiveAppearance:
    """The animal's surface and skin (agent frame), and the room as binary glTF (world frame)."""

    mesh: Mesh
    skin: Skin
    scene: bytes


class LiveView:
    """One animal, one room, one visitor."""

    def __init__(
        self,
        simulator: Simulator,
        look: LiveAppearance,
        observer: Float[np.ndarray, "3"],
        *,
        seed: int,
        port: int,
    ):
        try:
            import viser  # late: an extra
        except ImportError as error:
            what, where = f"the live view needs viser: {error}", "the Python environment"
            raise InputError("SIM-010", what, where, "install it: make extras") from error
        self.simulator, self.seed = simulator, seed
        self.server = _serving_own_page_only(viser.ViserServer, port)
        self.server.scene.set_up_direction("+y")
        self.server.scene.add_glb("/room", look.scene)
        self.person = self.server.scene.add_transform_controls(
            "/person",
            scale=0.5,
            active_axes=(True, False, True),
            disable_rotations=True,
            position=tuple(observer),
        )
        self.server.scene.add_icosphere("/person/head", PERSON_M, PERSON)
        self.goal = self.server.scene.add_icosphere("/goal", GOAL_M, GOAL)
        self.animal = self._add_animal(look)
        self._add_controls()
        self.reset()

    @property
    def port(self) -> int:
        """Port of the server."""
        return self.server.get_port()

    def reset(self) -> None:
        """Begin again, at a recorded moment that the seed picks."""
        self.states = [self.simulator.reset(self.seed)]
        self.seen = [np.array(self.person.position, float)]
        self._show(self.states[-1])

    def run(self, stopped: Callable[[], bool] = lambda: False) -> Take:
        """Let time pass until `stopped` or interrupted."""
        due = time.monotonic()
        try:
            while not stopped():
                if self.again.is_set():
                    self.again.clear()
                    self.seed += 1
                    self.reset()
                if self.playing.value:
                    self.step()
                due = max(due + 1 / RATE_HZ, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
        except KeyboardInterrupt:
            pass
        finally:
            self.server.stop()
        return take_of(self.states, self.seen)

    def step(self) -> None:
        """Let 0.1 s pass with the person where the visitor has put it."""
        animals, guidance = self.simulator.animals, float(self.interactivity.value)
        if guidance != animals.sampling.guidance:
            animals.sampling = replace(animals.sampling, guidance=guidance)
            animals.invalidate_plans()
        position = np.array(self.person.position, float)
        self.states.append(self.simulator.step(position))
        self.seen.append(position)
        self._show(self.states[-1])

    def _show(self, state: SimulatorState) -> None:
        turns = rigid.quaternion_from_rotation(state.agent_from_bone[:, :3, :3].astype(np.float64))
        root = rigid.quaternion_from_rotation(state.world_from_agent[:3, :3])
        with self.server.atomic():
            self.animal.position, self.animal.wxyz = state.world_from_agent[:3, 3], root
            for bone, handle in enumerate(self.animal.bones):
                handle.position, handle.wxyz = state.agent_from_bone[bone, :3, 3], turns[bone]
            self.goal.position = state.goal_world

    def _add_animal(self, look: LiveAppearance) -> Any:
        weights = np.zeros((len(look.mesh.vertices), len(look.skin.bone_names)), np.float32)
        np.add.at(weights, (np.arange(len(weights))[:, None], look.skin.joints), look.skin.weights)
        rest = look.skin.agent_from_bone_rest
        red, green, blue = FUR if look.mesh.color is None else look.mesh.color.mean(0).astype(int)
        return self.server.scene.add_mesh_skinned(
            "/animal",
            look.mesh.vertices.astype(np.float32),
            look.mesh.faces,
            bone_wxyzs=rigid.quaternion_from_rotation(rest[:, :3, :3]),
            bone_positions=rest[:, :3, 3],
            skin_weights=weights,
            color=(int(red), int(green), int(blue)),
            side="double",
        )

    def _add_controls(self) -> None:
        gui = self.server.gui
        scale = min(self.simulator.animals.sampling.guidance, MAX_GUIDANCE)
        self.interactivity = gui.add_slider("interactivity", 0.0, MAX_GUIDANCE, SLIDER_STEP, scale)
        self.playing = gui.add_checkbox("time passes", True)
        self.again = Event()  # clicks come on another thread, perhaps in the middle of a step
        gui.add_button("start again, next seed").on_click(lambda _event: self.again.set())


def _serving_own_page_only(start: Callable[..., Any], port: int) -> Any:
    """Start viser's server with a check of Host and Origin, which it lacks, against requests of other sites.

    Raises SIM-010 if viser does not start its server by `websockets.asyncio.server.serve`.
    """
    from websockets.asyncio import server  # late: comes with viser

    serve, checked = server.serve, []

    def checked_serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            headers, own_port = request.headers, connection.local_address[1]
            if not loopback.is_own(own_port, headers.get_all("Host"), headers.get_all("Origin")):
                return connection.respond(HTTPStatus.FORBIDDEN, "")
            return process_request(connection, request)

        checked.append(process)
        return serve(*arguments, process_request=process, **options)

    server.serve = checked_serve
    try:
        started = start(host=loopback.HOST, port=port, verbose=False)
    finally:
        server.serve = serve
    if not checked:
        started.stop()
        what = "this version of viser would answer other sites"
        remedy = "install the version of envs/extras.txt: make extras"
        raise InputError("SIM-010", what, "the Python environment", remedy)
    return started
