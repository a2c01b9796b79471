"""Several animals in one home with one person. Each has its own networks and body, perceives the others as
companions and avoids them. Any of them may be a replayed recording instead.
"""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from pipeline.behavior.simulator import Simulator, SimulatorState
from pipeline.behavior.trajectories import RATE_HZ, TRAIN, BehaviorData
from pipeline.data import images
from pipeline.environments.moments import moments_together, recorded_at
from pipeline.environments.residents import companions_of
from pipeline.geometry import views
from pipeline.geometry.meshes import Mesh
from stages.simulate.observers import Observer
from stages.simulate.rollout import Take, take_of, write_take

Companions = Float[np.ndarray, "companion past_frame 4"] | None
"""Past world positions (meters) and kinds of the other animals; None if there are none"""
PERSON_RGB = (47, 111, 159)
COLORS = [(200, 114, 43), (76, 128, 103), (140, 86, 160), (190, 60, 70), (90, 90, 90)] * 3
"""Of animals in order."""
RING_M, ANGLES = 0.1, np.linspace(0, 2 * np.pi, 25)
PALE = 0.45
"""Share of the room's colors that is left under what is drawn over it."""


class ReplayedAnimal:
    """A recorded animal: plays from its window to the end of the unbroken stretch, then loops it.

    Stands in for a `Simulator`.
    """

    def __init__(self, data: BehaviorData):
        self.data = data

    def begin(
        self, window: Int[np.ndarray, "1"], rng: np.random.Generator, *, companions: Companions = None
    ) -> SimulatorState:
        """Begin at a window; companions have no effect."""
        self.track, start = recorded_at(self.data, int(window[0]))
        broken = np.flatnonzero(~self.track.valid)
        first = int(broken[broken < start].max(initial=-1)) + 1
        last = int(broken[broken > start].min(initial=len(self.track.valid)))
        self.frames, self.now, self.time = np.arange(first, last), start - first + self.data.past - 1, 0
        return self._state()

    def step(self, observer: Float[np.ndarray, "3"], companions: Companions = None) -> SimulatorState:
        """Let 0.1 s pass."""
        self.now, self.time = self.now + 1, self.time + 1
        return self._state()

    @property
    def past_world(self) -> Float[np.ndarray, "past_frame 3"]:
        """Return where it has been, now last; meters."""
        past = np.arange(self.now - self.data.past + 1, self.now + 1) % len(self.frames)
        return self.track.world_from_agent[self.frames[past], :3, 3]

    def _state(self) -> SimulatorState:
        frame, roots = self.frames[self.now % len(self.frames)], self.track.world_from_agent
        bones = self.track.agent_from_bone[frame].astype(np.float64)
        time_s, end = self.time / self.data.rate_hz, roots[self.frames[-1], :3, 3]
        return SimulatorState(time_s, roots[frame], bones, end, 0.0)


class SharedHome:
    """Simulator of all animals of a home, by name; the action is the person's position in the world."""

    def __init__(self, animals: Mapping[str, Simulator | ReplayedAnimal]):
        self.animals = animals

    def reset(self, seed: int) -> dict[str, SimulatorState]:
        """Begin at a random training window of the first animal; the others at their windows nearest in time
        without overlap of bodies.
        """
        rng = np.random.default_rng(seed)
        data = {name: animal.data for name, animal in self.animals.items()}
        first = next(iter(data))
        window = int(rng.choice(data[first].indices(TRAIN), 1)[0])
        self.recording, _ = recorded_at(data[first], window)
        begun = {name: np.array([each]) for name, each in moments_together(data, first, window).items()}
        past = {
            name: data[name].windows(each)[0].world_from_agent[0, :, :3, 3] for name, each in begun.items()
        }
        return {
            name: self.animals[name].begin(begun[name], each, companions=companions_of(name, past))
            for name, each in zip(begun, rng.spawn(len(begun)), strict=True)
        }

    def step(self, observer: Float[np.ndarray, "3"]) -> dict[str, SimulatorState]:
        """Let 0.1 s pass for all with the person at this position (meters, world)."""
        past = {name: animal.past_world for name, animal in self.animals.items()}
        return {name: each.step(observer, companions_of(name, past)) for name, each in self.animals.items()}


def rollout_of_all(home: SharedHome, observer: Observer, *, seconds: float, seed: int) -> dict[str, Take]:
    """Simulate all animals for some seconds with an observer who attends to the nearest of them."""
    states = {name: [state] for name, state in home.reset(seed).items()}
    first = next(iter(states.values()))[0]
    seen = [observer(0.0, first.world_from_agent[:3, 3])]
    for _ in range(round(seconds * RATE_HZ)):
        places = np.stack([past[-1].world_from_agent[:3, 3] for past in states.values()])
        nearest = places[np.linalg.norm(places - seen[-1], axis=-1).argmin()]
        seen.append(observer(first.time_s + (len(seen) - 1) / RATE_HZ, nearest))
        for name, state in home.step(seen[-1]).items():
            states[name].append(state)
    return {name: take_of(past, seen) for name, past in states.items()}


def write_takes(folder: Path, takes: Mapping[str, Take], scene: Mesh) -> None:
    """Write each animal's take into a folder of its name, and `from_above.jpg`: the room with the labeled
    tracks of all animals and of the person (blue).
    """
    first = next(iter(takes.values()))
    lowest = min(float(take.world_from_agent[:, 1, 3].min()) for take in takes.values())
    room = views.bird_view(scene, floor_m=lowest)
    room.image[:] = np.round(PALE * room.image + (1 - PALE) * views.BACKGROUND)
    tracks = {"person": first.observer_world}
    tracks |= {name: take.world_from_agent[:, :3, 3] for name, take in takes.items()}
    for (name, track), color in zip(tracks.items(), [PERSON_RGB, *COLORS], strict=False):
        room.draw(track, color)
        ring = track[0] + RING_M * np.stack([np.cos(ANGLES), 0 * ANGLES, np.sin(ANGLES)], axis=-1)
        room.draw(ring, color, 3)
        label_px = tuple(np.round(room.pixel(ring[:1])[0]).astype(int).tolist())
        cv2.putText(room.image, f" {name}", label_px, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)
    for name, take in takes.items():
        (folder / name).mkdir()
        write_take(folder / name, take)
    images.write_color(folder / "from_above.jpg", room.image)
