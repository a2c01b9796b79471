// For tests and for the curious, as `window.ats`: ask the page the same questions that it asks itself.

import { arranged } from './furniture.js';
import { rotate } from './rigid.js';
import { rootOf } from './timeline.js';

export function api(simulator) {
  const { room, observer, planner } = simulator;
  const selected = () => simulator.selected;
  return {
    contract: simulator.contract,
    select: (name) => {
      simulator.state.animal = name;
      simulator.changed('animal');
      simulator.panel.refresh();
    },
    employ: (name, does) => simulator.employ(name, does),
    state: () => {
      const { stops, route, take, timeline, turnNumber, clips } = selected();
      const root = rootOf(timeline.at(simulator.now));
      return {
        tick: simulator.now,
        animal: root,
        nose: rotate(root.slice(3), [0, 0, 1]),
        observer: [...observer.place],
        eye: room.camera.getWorldPosition(room.camera.position.clone()).toArray(),
        headset: simulator.headset.presenting,
        outlined: selected().outline.visible,
        plans: turnNumber,
        milliseconds: simulator.milliseconds,
        aim: stops.next,
        stops: stops.left,
        route: route && {
          points: route.points,
          done: route.done,
          length: route.length,
        },
        replay: simulator.replaying && {
          name: simulator.replaying.name,
          tick: simulator.replayTick,
          place: [...clips.frame(simulator.replaying, simulator.replayTick).slice(0, 3)],
        },
        animals: simulator.residents.map((each) => ({
          name: each.name,
          does: each.does,
          place: rootOf(each.timeline.at(simulator.now)),
          plans: each.turnNumber,
        })),
        selected: selected().name,
        take_s: take.seconds,
        software: room.software,
        marks_s: Object.fromEntries(
          performance.getEntriesByType('mark').map((mark) => [mark.name, mark.startTime / 1000]),
        ),
        pixelRatio: room.renderer.getPixelRatio(),
        settings: { ...simulator.state },
      };
    },
    // observer: its last places on the floor, [[x, z], ...], oldest first (or one place where it stands
    // still).
    sampleGoals: async ({ observer: seen, seed = 0, K = 16, steps = 10, ...rest }) => {
      const places = typeof seen?.[0] === 'number' ? [seen] : seen;
      const { count } = selected();
      const walked =
        places && Array.from({ length: count }, (_, i) => places[Math.max(0, places.length - count + i)]);
      const changes = walked
        ? { observer: walked.map((place) => observer.pose(place, selected().place)) }
        : {};
      const answer = await planner.goals(
        selected().question({ ...changes, seed, samples: K, steps, aim: null, path: null, ...rest }),
      );
      return answer.goals;
    },
    plan: (changes = {}) => planner.plan(selected().question({ seed: 0, ...changes })),
    golden: (golden, animal = 0) => planner.golden(golden, animal),
    pause: () => {
      if (simulator.playing) simulator.play();
    },
    play: () => {
      if (!simulator.playing) simulator.play();
    },
    reset: () => simulator.reset(),
    // Furniture that can be moved, what has been, and the volume of the selected animal as it is then.
    furniture: () => {
      const { mover } = simulator;
      const { furniture, homes } = mover;
      const own = homes[selected().index];
      return {
        pieces: furniture.pieces.map((piece) => ({
          columns: piece.columns.map((column) => furniture.grid.columnCenter(column)),
          top: furniture.grid.center(piece.cells.at(-1)),
          cells: piece.cells.length,
          by: mover.by.get(piece) ?? [0, 0],
        })),
        occupancy: Array.from(arranged(own, own.arrangement?.moves ?? []).occupancy),
        allowed: Array.from(own.arrangement?.allowed ?? own.allowed),
        triangles: room.mesh.geometry.index.count / 3,
        held: mover.held && { by: mover.held.by },
      };
    },
    visit: (points) => simulator.visit(points),
    moveObserver: (place) => {
      observer.place = [...place];
      observer.target = null;
      simulator.taken = true;
    },
    // A point of the world, or a mesh's place, in pixels of the window.
    screen: (point) => {
      room.orbit.update();
      room.camera.updateMatrixWorld();
      const spot = room.orbit.target
        .clone()
        .set(...point)
        .project(room.camera);
      return [((spot.x + 1) / 2) * innerWidth, ((1 - spot.y) / 2) * innerHeight];
    },
    // What the view is turned about, world meters.
    target: () => room.orbit.target.toArray(),
    frames: () => simulator.frames ?? 0,
  };
}
