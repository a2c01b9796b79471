// The page: unpack, build the room, let the animal live, plan ahead in a worker, and listen to the visitor.

import * as assets from './assets.js';
import { Animal } from './animal.js';
import { Clips } from './clips.js';
import { Controls } from './controls.js';
import { Minimap } from './minimap.js';
import { Observer } from './observer.js';
import { Overlays } from './overlays.js';
import * as panel from './panel.js';
import { Planner } from './planner.js';
import { ROW, apply, rotate } from './rigid.js';
import { Room } from './room.js';
import { readPoint, readState, writeState } from './state.js';
import { Timeline, rootOf } from './timeline.js';

const TICK_S = 0.1;
const REPLAN_TICKS = 7;
const ARRIVED_M = 0.25;

class Simulator {
  async open() {
    this.state = readState();
    this.contract = await assets.json('simulator');
    panel.progress(0.15, 'opening the room');
    this.room = new Room(document.getElementById('view'), this.contract);
    await this.room.addMesh(await assets.bytes('room'));
    panel.progress(0.3, 'waking the animal');
    this.clips = new Clips(this.contract, await assets.floats('clips'));
    this.animal = (await Animal.parse(await assets.bytes('agent'))).addTo(this.room.scene);
    this.ghost = this.animal.ghost(0xc8722b, 0.16).addTo(this.room.scene);
    this.recorded = this.animal.ghost(0x6d675e, 0.6).addTo(this.room.scene);
    this.recorded.visible = this.ghost.visible = false;
    this.observer = new Observer(this.contract);
    this.room.scene.add(this.observer.figure);
    this.overlays = new Overlays(this.room.scene, this.contract.scene.floor_m, this.contract.agent.root_height_m[0] - this.contract.scene.floor_m);
    this.map = new Minimap(document.getElementById('minimap'), this.room.picture(256));
    this.clips.each((frame, camera) => {
      this.map.visit('animal', frame[0], frame[2], 0.25);
      this.map.visit('observer', camera[0], camera[2], 0.25);
    });
    panel.progress(0.45, 'unpacking its mind');
    this.planner = await Planner.open(this.contract, (share) => panel.progress(0.45 + 0.5 * share, 'unpacking its mind'));
    this.connect();
    this.reset();
    panel.progress(1, 'ready');
    panel.ready();
    this.last = performance.now();
    this.room.renderer.setAnimationLoop(() => this.frame());
    await this.addSplats();
  }

  // Splats need a real graphics card; in software the mesh is kinder.
  async addSplats() {
    const wanted = new URLSearchParams(location.search);
    if (wanted.has('mesh') || (this.room.software && !wanted.has('splats'))) return;
    const rows = await assets.bytes('splats');
    if (rows) await this.room.addSplats(rows);
  }

  connect() {
    this.playing = true;
    this.panel = panel.buildPanel(this.state, this.clips.list, {
      change: (key) => this.changed(key),
      play: () => this.play(),
      reset: () => this.reset(),
      free: () => this.aimAt(null),
    });
    this.controls = new Controls(this.room, this.observer, { play: () => this.play(), reset: () => this.reset(), aim: (point) => this.aimAt(point) });
    addEventListener('hashchange', () => {
      Object.assign(this.state, readState());
      this.panel.refresh();
      this.reset();
    });
    this.changed('');
  }

  play() {
    this.playing = !this.playing;
    panel.showPlaying(this.playing);
  }

  changed(key) {
    writeState(this.state);
    Object.assign(this.overlays.layers, { goals: Boolean(this.state.goals), path: Boolean(this.state.path) });
    this.overlays.refresh();
    this.replaying = this.clips.list.find((clip) => clip.name === this.state.replay) ?? null;
    this.replayTick = 0;
    if (key === 'seed') this.reset();
    else if (!['goals', 'path', 'speed', 'replay'].includes(key)) this.urgent = true;
  }

  // Begin at a recorded moment that the seed picks; the observer stands where the person stood.
  reset() {
    const moment = this.clips.moment(this.state.seed, this.contract.behavior.past_frames);
    this.timeline = new Timeline(moment.frames);
    this.now = 0;
    this.turnNumber = 0;
    this.waiting = false;
    this.urgent = true;
    this.planStart = -REPLAN_TICKS;
    this.overlays.plan = null;
    this.overlays.refresh();
    this.aim = readPoint(this.state.aim);
    panel.showFree(Boolean(this.aim));
    this.observer.animal = moment.frames.at(-1).slice(0, 3);
    this.observer.place = readPoint(this.state.at) ?? [moment.observer[0], moment.observer[2]];
    this.observer.target = null;
    this.observer.settle();
    this.epoch = (this.epoch ?? 0) + 1;
  }

  aimAt(point) {
    this.aim = point;
    this.state.aim = point ? point.map((value) => value.toFixed(2)).join(',') : '';
    writeState(this.state);
    panel.showFree(Boolean(point));
    this.urgent = true;
  }

  frame() {
    const time = performance.now();
    const seconds = Math.min(0.25, (time - this.last) / 1000);
    this.last = time;
    if (this.playing) {
      this.advance(seconds * this.state.speed, seconds);
      this.room.attend(this.observer.animal, seconds);
    }
    this.draw();
  }

  advance(seconds, wallSeconds) {
    const before = Math.floor(this.now);
    // Never run past what is planned: wait for the mind rather than freeze in mid-step.
    this.now = this.timeline.plans.length ? Math.min(this.now + seconds / TICK_S, this.now + Math.max(0, this.timeline.ticksLeft(this.now))) : this.now;
    const walked = this.observer.step(wallSeconds, this.controls.direction(), this.room.heading());
    if (walked) this.moved = true;
    for (let tick = before; tick < Math.floor(this.now); tick++) {
      this.observer.tick();
      this.map.visit('animal', this.observer.animal[0], this.observer.animal[2]);
      this.map.visit('observer', ...this.observer.place);
      this.replayTick += 1;
      if (this.moved && tick % 10 === 0) this.rememberPlace();
    }
    this.timeline.record(this.now);
    this.plan();
  }

  rememberPlace() {
    this.state.at = this.observer.place.map((value) => value.toFixed(2)).join(',');
    writeState(this.state);
    this.moved = false;
  }

  async plan() {
    if (this.waiting || !(this.urgent || this.now - this.planStart >= REPLAN_TICKS)) return;
    this.waiting = true;
    this.urgent = false;
    const epoch = this.epoch;
    const start = Math.floor(this.now);
    this.planStart = this.now;
    let plan;
    try {
      plan = await this.planner.plan(this.question({ seed: this.state.seed * 1009 + this.turnNumber++ }));
    } catch (error) {
      return panel.status(`cannot plan: ${error.message}`);
    }
    if (epoch !== this.epoch) return;
    this.waiting = false;
    this.timeline.follow(start, plan.frames, this.now);
    this.overlays.show(plan);
    this.ghost.pose(plan.frames.at(-1), this.contract.scene.floor_m);
    this.milliseconds = plan.milliseconds;
    panel.status(`planned ${(plan.frames.length * TICK_S).toFixed(1)} s ahead in ${(plan.milliseconds / 1000).toFixed(2)} s`);
    if (this.aim && Math.hypot(this.aim[0] - this.observer.animal[0], this.aim[1] - this.observer.animal[2]) < ARRIVED_M) this.aimAt(null);
  }

  // What the mind is asked: the shown past, the observer's past, and the visitor's settings.
  question(changes = {}) {
    const { state } = this;
    const count = this.contract.behavior.past_frames;
    return {
      past: this.timeline.past(count),
      observer: this.observer.history.slice(-count),
      keep: { scene: state.scene, observer: state.observer, past: state.past, goal: state.goal },
      interactivity: state.interactivity,
      samples: state.samples,
      steps: state.steps,
      aim: this.aim ? [this.aim[0], this.observer.animal[1], this.aim[1]] : null,
      ...changes,
    };
  }

  draw() {
    const { floor_m: floor } = this.contract.scene;
    const frame = this.timeline.at(this.now);
    const root = rootOf(frame);
    this.observer.animal = root.slice(0, 3);
    this.animal.pose(frame, floor);
    this.overlays.follow(root);
    this.ghost.visible = Boolean(this.overlays.plan) && Boolean(this.state.goals);
    const recorded = this.replaying && this.clips.frame(this.replaying, this.replayTick);
    this.recorded.visible = Boolean(recorded);
    if (recorded) this.recorded.pose(recorded, floor);
    this.frames = (this.frames ?? 0) + 1;
    if (this.frames % (this.room.software ? 6 : 3) === 0) this.drawMap(root, recorded);
    this.room.render();
  }

  drawMap(root, recorded) {
    const plan = this.overlays.plan;
    const nose = rotate(root.slice(3), [0, 0, 1]);
    const [x, z] = this.observer.place;
    this.map.draw({
      animal: { x: root[0], z: root[2], heading: Math.atan2(nose[0], nose[2]) },
      observer: { x, z, heading: Math.atan2(root[0] - x, root[2] - z) },
      goals: this.state.goals ? plan?.goals : null,
      chosen: plan?.chosen,
      path: this.state.path ? plan?.path : null,
      recorded,
    });
  }
}

// For tests and for the curious: ask the page the same questions that it asks itself.
function api(simulator) {
  return {
    ready: true,
    contract: simulator.contract,
    state: () => {
      const root = rootOf(simulator.timeline.at(simulator.now));
      return {
        tick: simulator.now,
        animal: root,
        nose: rotate(root.slice(3), [0, 0, 1]),
        observer: [...simulator.observer.place],
        plans: simulator.turnNumber,
        milliseconds: simulator.milliseconds,
        aim: simulator.aim,
        software: simulator.room.software,
        settings: { ...simulator.state },
      };
    },
    // observer: its last places on the floor, [[x, z], ...], oldest first (or one place where it stands still).
    sampleGoals: async ({ observer, seed = 0, K = 16, steps = 10, ...rest }) => {
      const places = typeof observer?.[0] === 'number' ? [observer] : observer;
      const count = simulator.contract.behavior.past_frames;
      const walked = places && Array.from({ length: count }, (_, i) => places[Math.max(0, places.length - count + i)]);
      const changes = walked ? { observer: walked.map((place) => simulator.observer.pose(place)) } : {};
      const answer = await simulator.planner.goals(simulator.question({ ...changes, seed, samples: K, steps, aim: null, ...rest }));
      return answer.goals;
    },
    plan: (changes = {}) => simulator.planner.plan(simulator.question({ seed: 0, ...changes })),
    golden: (golden) => simulator.planner.golden(golden),
    pause: () => { if (simulator.playing) simulator.play(); },
    play: () => { if (!simulator.playing) simulator.play(); },
    reset: () => simulator.reset(),
    aimAt: (point) => simulator.aimAt(point),
    moveObserver: (place) => { simulator.observer.place = [...place]; simulator.observer.target = null; },
    screen: (point) => {
      const camera = simulator.room.camera;
      const spot = simulator.room.orbit.target.clone().set(...point).project(camera);
      return [((spot.x + 1) / 2) * innerWidth, ((1 - spot.y) / 2) * innerHeight];
    },
    frames: () => simulator.frames ?? 0,
    apply,
    ROW,
  };
}

function missing() {
  const canvas = document.createElement('canvas');
  if (!canvas.getContext('webgl2')) return ['This page draws in 3D and your browser offers no WebGL 2.', 'Turn on hardware acceleration, or open the page in a current Firefox, Chrome, Edge or Safari.'];
  if (typeof WebAssembly !== 'object') return ['The animal thinks in WebAssembly, which is switched off here.', 'Open the page in another browser, or leave lockdown mode for it.'];
  if (typeof DecompressionStream !== 'function') return ['Your browser is too old to unpack this page.', 'A browser of 2023 or later will do.'];
  return null;
}

const lack = missing();
if (lack) panel.sorry(...lack);
else {
  const simulator = new Simulator();
  simulator.open().then(
    () => { window.ats = api(simulator); },
    (error) => {
      panel.sorry(`Something went wrong while opening: ${error.message}`, 'Reload the page; if it stays, build the simulator again.');
      console.error(error);
    },
  );
}
