// The page: unpack, build the room, let the animal live, plan ahead in a worker, and listen to the visitor.

import * as assets from './assets.js';
import { Animal } from './animal.js';
import { api } from './api.js';
import { Clips } from './clips.js';
import { Controls } from './controls.js';
import { Film } from './film.js';
import { filledFloor } from './floor.js';
import { Headset } from './headset.js';
import { Minimap } from './minimap.js';
import { arrays } from './npz.js';
import { Observer } from './observer.js';
import { Overlays } from './overlays.js';
import * as panel from './panel.js';
import { Planner } from './planner.js';
import { rotate } from './rigid.js';
import { Room } from './room.js';
import { Route } from './route.js';
import { readPlaces, readPoint, readState, writeState } from './state.js';
import { Stops, metres, placesText } from './stops.js';
import { Support } from './support.js';
import { BODY_M } from './avoidance.js';
import { distance } from './path_encoding.js';
import { Tags } from './tags.js';
import { Take, save } from './take.js';
import { Timeline, rootOf } from './timeline.js';

const TICK_S = 0.1;
const AGAIN_MS = 1000; // after a plan that failed, the next is asked for
const MOST_STOPS = 9;
const CALL_M = 0.6; // before the person, on the animal's side, an animal stops that is called
const NOTICE_TICKS = 20; // how long is shown that it noticed the person
// a click on furniture counts where a recorded root was this near, level and upright
const BEEN_M = [0.45, 0.12];
const RAISED_M = 0.3; // a click on furniture belongs to a top that is no further up or down
const AVOID_TICKS = 12; // so far ahead a plan is checked for the person's body

class Simulator {
  async open() {
    this.contract = await assets.json('simulator');
    panel.progress(0.15, 'opening the room');
    this.room = new Room(document.getElementById('view'), this.contract);
    await this.room.addMesh(await assets.bytes('room'));
    panel.progress(0.3, 'loading the animal');
    this.clips = new Clips(this.contract, await assets.floats('clips'));
    this.model = await assets.bytes('agent');
    const { state, ignored } = readState(this.contract, this.clips.list);
    this.state = state;
    this.animal = (await Animal.parse(this.model)).addTo(this.room.scene);
    this.outline = this.animal.outline(0xf08a3c).addTo(this.room.scene);
    this.outline.visible = false;
    this.ghost = this.animal.ghost(0xc8722b, 0.16).addTo(this.room.scene);
    this.recorded = this.animal.ghost(0x6d675e, 0.6).addTo(this.room.scene);
    this.recorded.visible = this.ghost.visible = false;
    this.observer = new Observer(this.contract);
    this.room.scene.add(this.observer.figure);
    this.overlays = new Overlays(
      this.room.scene,
      this.contract.scene.floor_m,
      this.contract.agent.root_height_m[0] - this.contract.scene.floor_m,
    );
    this.tags = new Tags(this.room.camera);
    this.film = new Film(this.room.canvas);
    this.room.frameRoom(
      this.clips.moment(this.state.seed, this.contract.behavior.past_frames).frames.at(-1).slice(0, 3),
    );
    this.map = new Minimap(document.getElementById('minimap'), this.room.picture(256), this.room.heading());
    this.clips.each((frame, camera) => {
      this.map.visit('animal', frame[0], frame[2], 0.25);
      this.map.visit('observer', camera[0], camera[2], 0.25);
    });
    const allowed = await assets.bytes('allowed');
    const sheet = filledFloor(this.contract.volume, allowed, this.contract.scene.floor_m);
    if (sheet) this.room.scene.add(sheet);
    this.support = new Support(this.contract.volume, allowed);
    this.connect();
    this.reset();
    panel.progress(1, 'ready');
    panel.ready();
    this.complain(ignored);
    if (this.contract.scene.warning) panel.warn(this.contract.scene.warning);
    this.last = performance.now();
    this.room.renderer.setAnimationLoop(() => this.frame());
    // the animal is seen while what it plans with is loaded
    this.planner = await Planner.open(this.contract, allowed, (share) =>
      panel.status(`loading the behaviour model, ${Math.round(100 * share)} %`),
    );
    await this.addSplats().catch((error) => {
      this.remark = `; drawn as a mesh, without splats: ${error.message}`;
    });
  }

  // Splats need a real graphics card; in software the mesh is kinder, and where they fail.
  async addSplats() {
    const wanted = new URLSearchParams(location.search);
    if (wanted.has('mesh') || (this.room.software && !wanted.has('splats'))) return;
    const rows = await assets.bytes('splats');
    if (rows) await this.room.addSplats(rows);
    const body = await assets.bytes('agent-splats');
    if (body)
      await this.animal.addSplats(
        body,
        await assets.bytes('agent-skin'),
        this.contract.agent.rest,
        this.room.scene,
      );
  }

  connect() {
    this.playing = true;
    this.panel = panel.buildPanel(this.state, this.contract, {
      change: (key) => this.changed(key),
      play: () => this.play(),
      reset: () => this.reset(),
      free: () => this.visit([]),
      call: () => this.call(),
      hold: (tool) => this.hold(tool),
      csv: () => save(this.take.csv(), `${this.fileName}.csv`),
      glb: () => save(this.take.glb(this.model), `${this.fileName}.glb`),
      film: () => this.shoot(),
      toml: () => save(this.stops.toml, `${this.fileName}_subgoals.toml`),
      link: panel.copyLink,
      open: (file) => this.openTake(file),
      headset: () => this.enterHeadset(),
    });
    panel.showFilm(false, Film.possible);
    this.controls = new Controls(this.room, this.observer, {
      play: () => this.play(),
      reset: () => this.reset(),
      aim: (surface, further) => this.aim(surface, further),
      call: () => this.call(),
      hold: (tool) => this.hold(tool),
      how: panel.howTo,
      tell: () => panel.say(this.whereabouts()),
      stroke: (points) => this.overlays.ask(points),
      drawn: (points) => this.follow(points),
      carry: (point) => {
        this.observer.target = point;
        this.taken = true;
      },
    });
    this.room.canvas.addEventListener('webglcontextlost', () =>
      panel.sorry(
        'The graphics card has dropped this page.',
        'Reload it; if that keeps happening, close other pages that draw in 3D.',
      ),
    );
    addEventListener('hashchange', () => {
      const { state, ignored } = readState(this.contract, this.clips.list);
      Object.assign(this.state, state);
      this.complain(ignored);
      this.panel.refresh();
      this.changed('view');
      this.reset();
    });
    this.headset = new Headset(this.room, this.observer, this.contract.scene.floor_m, {
      aim: (surface) => this.aim(surface, false),
      call: () => this.call(),
      change: (presenting) => document.body.classList.toggle('headset', presenting),
    });
    Headset.possible().then(panel.showHeadset);
    this.changed('');
  }

  async enterHeadset() {
    try {
      await this.headset.start();
    } catch (error) {
      panel.help(`The headset cannot be used: ${error.message}.`, 6);
    }
  }

  // Where the animal is, for those who do not see it.
  whereabouts() {
    const [x, , z] = this.observer.animal;
    const [dx, dz] = [x - this.observer.place[0], z - this.observer.place[1]];
    const turn = Math.atan2(dx, dz) - this.room.heading();
    const sides = ['ahead', 'ahead to the left', 'left', 'behind to the left', 'behind'];
    const eighth = Math.round(Math.atan2(Math.sin(turn), Math.cos(turn)) / (Math.PI / 4));
    const side = eighth < 0 ? sides[-eighth].replace('left', 'right') : sides[eighth];
    return `${this.contract.name} is ${Math.hypot(dx, dz).toFixed(1)} metres away, ${side}`;
  }

  play() {
    this.playing = !this.playing;
    panel.showPlaying(this.playing);
  }

  changed(key) {
    writeState(this.state, this.contract);
    Object.assign(this.overlays.layers, { goals: Boolean(this.state.goals), path: Boolean(this.state.path) });
    this.overlays.refresh();
    this.replaying = this.clips.list.find((clip) => clip.name === this.state.replay) ?? null;
    if (key === 'view') this.room.look(this.state.view, this.eyes(), this.observer.animal);
    if (key === 'seed' || key === 'replay') this.reset();
    else if (!['goals', 'path', 'outline', 'speed', 'view'].includes(key)) this.urgent = true;
  }

  // Begin at a recorded moment that the seed picks, or where the clip beside begins; the observer stands
  // where the person stood and, beside a clip, walks as the person walked until somebody takes over.
  reset() {
    const count = this.contract.behavior.past_frames;
    const moment = this.replaying
      ? this.clips.beginning(this.replaying, count)
      : this.clips.moment(this.state.seed, count);
    this.replayTick = count - 1;
    this.taken = Boolean(this.state.at);
    this.take = new Take();
    this.timeline = new Timeline(moment.frames);
    this.now = 0;
    this.turnNumber = 0;
    this.waiting = false;
    this.urgent = true;
    this.noticedAt = undefined;
    this.overlays.plan = null;
    this.overlays.refresh();
    this.observer.animal = moment.frames.at(-1).slice(0, 3);
    this.observer.place = readPoint(this.state.at)?.slice(0, 2) ?? [moment.observer[0], moment.observer[2]];
    this.observer.target = null;
    this.observer.settle();
    const route = readPlaces(this.state.route);
    this.route =
      route.length > 1 ? new Route([[this.observer.animal[0], this.observer.animal[2]], ...route]) : null;
    this.stops = new Stops(
      this.route ? [] : readPlaces(this.state.aim),
      rootOf(this.timeline.base),
      (point) => this.rootAt(point),
    );
    this.showCommands();
    if (this.state.view !== 'room') this.room.look(this.state.view, this.eyes(), this.observer.animal);
    this.epoch = (this.epoch ?? 0) + 1;
  }

  // What of a link means nothing here.
  complain(ignored) {
    if (ignored.length)
      panel.help(`Ignored, for it means nothing here: ${ignored.join(', ')} of this link.`, 10);
  }

  // A click: a goal on the floor, or on furniture where the animal has been; else a word why not.
  aim({ place: [x, z], up }, further) {
    let point = [x, z];
    if (up) {
      const floor = this.contract.scene.floor_m;
      const top = this.support
        .tops(x, z)
        .sort((a, b) => Math.abs(a - floor - up) - Math.abs(b - floor - up))[0];
      if (top === undefined || Math.abs(top - floor - up) > RAISED_M || !this.hasBeenOn(x, z, top))
        return panel.help(
          `${this.contract.name} has never been up there: click where it can be, or the floor beside.`,
          5,
        );
      point = [x, z, top - floor];
    }
    this.visit(further ? [...this.stops.left, point] : [point]);
  }

  // Whether a recording shows the root above a top of furniture at [x, z].
  hasBeenOn(x, z, top) {
    const [low, high] = this.contract.volume.support.range_m
      .flat()
      .reduce(
        ([least, most], value) => [Math.min(least, value), Math.max(most, value)],
        [Infinity, -Infinity],
      );
    let been = false;
    this.clips.each((frame) => {
      been ||=
        Math.hypot(frame[0] - x, frame[2] - z) < BEEN_M[0] &&
        frame[1] > top + low - BEEN_M[1] &&
        frame[1] < top + high + BEEN_M[1];
    });
    return been;
  }

  // The height of the root at a goal, world.
  rootAt(point) {
    const {
      scene: { floor_m: floor },
      agent: { standing_m: standing },
    } = this.contract;
    return point[2] ? this.support.carried([point[0], point[2] + standing, point[1]], false) : standing;
  }

  // Come to the person: as near as one comes to a body.
  call() {
    const [x, z] = this.observer.place;
    const [dx, dz] = [this.observer.animal[0] - x, this.observer.animal[2] - z];
    const far = Math.hypot(dx, dz) || 1;
    this.visit([[x + (dx * CALL_M) / far, z + (dz * CALL_M) / far]]);
  }

  // Go to one place after the other, [[x, z], ...]; with none it chooses for itself. What a journey has seen,
  // it keeps.
  visit(points) {
    if (points.length > MOST_STOPS) return panel.help(`${MOST_STOPS} goals at most.`, 4);
    if (this.stops.next && points.length > 1) this.stops.continue(points);
    else this.stops = new Stops(points, rootOf(this.timeline.at(this.now)), (point) => this.rootAt(point));
    this.route = null;
    this.showCommands();
    this.urgent = true;
  }

  // Walk along a stroke of points [x, z]; a dot is a goal.
  follow(points) {
    this.hold(null);
    if (points.length < 3) return points.length ? this.visit(points.slice(-1)) : this.showCommands();
    this.stops = new Stops();
    this.route = new Route([[this.observer.animal[0], this.observer.animal[2]], ...points]);
    this.showCommands();
    this.urgent = true;
  }

  // Take a tool in hand, 'pen' or 'pins', or put away the one that is held.
  hold(tool) {
    this.controls.tool = this.controls.tool === tool ? null : tool;
    panel.showTool(this.controls.tool);
  }

  // The visitor's goals or path: on the floor, in the address, and as a way out of it.
  showCommands() {
    const { left, points } = this.stops;
    this.state.aim = placesText(left);
    this.state.route = this.route ? placesText(this.route.corners) : '';
    writeState(this.state, this.contract);
    panel.showCommands(Boolean(left.length || this.route), points.length);
    this.overlays.ask(this.route?.points ?? null, left);
  }

  get fileName() {
    return `${this.contract.name.replace(/[^\w-]+/g, '_')}_seed${this.state.seed}`;
  }

  eyes() {
    return [this.observer.place[0], this.contract.scene.floor_m + this.observer.eye, this.observer.place[1]];
  }

  async shoot() {
    if (!this.film.running) {
      this.film.start();
      return panel.showFilm(true, true);
    }
    panel.showFilm(false, true);
    save(await this.film.stop(), `${this.fileName}.webm`);
  }

  // A take of `stages.simulate` plays beside, as a recorded clip does.
  async openTake(file) {
    try {
      const clip = this.clips.add(
        file.name.replace(/\.npz$/, ''),
        await arrays(new Uint8Array(await file.arrayBuffer())),
      );
      panel.addClip(clip);
      this.state.replay = clip.name;
      this.panel.refresh();
      this.changed('replay');
    } catch (error) {
      panel.help(`${file.name} cannot be played here: ${error.message}.`, 8);
    }
  }

  frame() {
    const time = performance.now();
    const seconds = Math.min(0.25, (time - this.last) / 1000);
    if (time - this.last < 1000 && !this.headset.presenting) this.room.steadiness.note(time - this.last);
    this.last = time;
    if (this.playing) {
      if (this.timeline.plans.length) this.advance(seconds * this.state.speed);
      // no time has passed: who has come since then has always stood here
      else if (this.walk(seconds)) this.observer.settle();
      this.plan();
      if (!this.headset.presenting) this.room.attend(this.observer.animal, seconds, this.eyes());
    }
    const [turn, closer] = this.controls.turning();
    if ((turn || closer) && !this.headset.presenting)
      this.room.turn(1.2 * turn * seconds, Math.exp(closer * seconds));
    this.draw();
  }

  // Let seconds pass, for animal and observer; never past what is planned: wait for the next plan rather than
  // freeze in mid-step.
  advance(seconds) {
    const end = this.now + Math.min(seconds / TICK_S, Math.max(0, this.timeline.ticksLeft(this.now)));
    while (this.now < end) {
      const next = Math.min(end, Math.floor(this.now) + 1);
      if (this.wouldMeet(next)) {
        this.timeline.hold(this.now);
        this.urgent = true;
      }
      this.walk((next - this.now) * TICK_S);
      this.now = next;
      if (Number.isInteger(next)) this.tick();
    }
    this.timeline.record(this.now);
  }

  // Whether the next moment would lead into the person's body: then the animal waits for a plan around it.
  wouldMeet(next) {
    const [x, z] = this.observer.place;
    const gap = (now) => {
      const frame = this.timeline.at(now);
      return Math.hypot(frame[0] - x, frame[2] - z);
    };
    const reach = Math.min(BODY_M, gap(this.now)) - 0.05;
    return gap(next) < reach && gap(next) < gap(this.now) - 1e-4;
  }

  tick() {
    this.observer.tick();
    this.map.visit('animal', this.observer.animal[0], this.observer.animal[2]);
    this.map.visit('observer', ...this.observer.place);
    this.replayTick += 1;
    this.take.add(
      this.timeline.at(this.now),
      this.observer.pose(),
      this.overlays.plan?.goals[this.overlays.plan.chosen],
    );
    if (this.stops.visit(this.observer.animal)) {
      panel.say(`${this.contract.name} has arrived`);
      this.showCommands();
      this.urgent = true;
    }
    if (this.replaying && !this.taken) this.followPerson();
    if (this.moved && this.now % 10 === 0) this.rememberPlace();
  }

  walk(seconds) {
    const walked = this.headset.presenting
      ? this.headset.step(seconds)
      : this.observer.step(seconds, this.controls.direction(), this.room.heading());
    if (walked) this.moved = this.taken = true;
    return walked;
  }

  // Beside a clip the observer walks as the person did.
  followPerson() {
    const camera = this.clips.camera(this.replaying, this.replayTick);
    this.observer.place = [camera[0], camera[2]];
    this.observer.step(0, [0, 0], 0);
  }

  rememberPlace() {
    this.state.at = this.observer.place.map(metres).join(',');
    writeState(this.state, this.contract);
    this.moved = false;
  }

  // Whether to ask for a plan: the one that is followed ends, or was made before the observer moved
  // noticeably. Replanned at every step, the goal would switch mid-walk; only a visitor's commands are
  // replanned at once.
  get due() {
    const { reaction_frames: soonest, blend_frames: fade } = this.contract.replanning;
    if (this.urgent) return true;
    const thinking = ((this.milliseconds ?? 0) / 1000 / TICK_S) * this.state.speed;
    if (this.timeline.ticksLeft(this.now) <= fade + thinking) return true;
    if (this.now - this.planStart < soonest) return false;
    if (this.stops.next || this.route) return true;
    if (this.bodyInTheWay) return true;
    return this.personMoved;
  }

  // Whether the person has moved noticeably since the animal made its plan.
  get personMoved() {
    const here = this.observer.pose();
    return (
      Boolean(this.state.observer) &&
      distance(here, this.noticed) >
        this.contract.replanning.observer_motion_ratio * distance(here, this.observer.animal)
    );
  }

  // Whether the plan leads nearer to the person's body than it may, and nearer than it is.
  get bodyInTheWay() {
    const [x, z] = this.observer.place;
    const gap = (frame) => Math.hypot(frame[0] - x, frame[2] - z);
    const reach = Math.min(BODY_M, gap(this.timeline.at(this.now))) - 0.02;
    return Array.from({ length: AVOID_TICKS }, (_, i) => this.timeline.at(this.now + i + 1)).some(
      (frame) => gap(frame) < reach,
    );
  }

  async plan() {
    if (!this.planner || this.waiting || !this.due) return;
    if (this.timeline.plans.length && this.state.interactivity > 0 && this.personMoved) this.notice();
    this.waiting = true;
    this.urgent = false;
    const epoch = this.epoch;
    const start = Math.floor(this.now);
    this.planStart = this.now;
    this.noticed = this.observer.pose();
    const stop = this.stops.next;
    let plan;
    try {
      plan = await this.planner.plan(this.question({ seed: this.state.seed * 1009 + this.turnNumber++ }));
    } catch (error) {
      panel.status(`cannot plan (${error.message}): trying again; if that does not help, reload the page`);
      return setTimeout(() => {
        if (epoch === this.epoch) Object.assign(this, { waiting: false, urgent: true });
      }, AGAIN_MS);
    }
    if (epoch !== this.epoch) return;
    this.waiting = false;
    this.timeline.follow(start, plan.frames, this.now);
    if (plan.cleared) this.stops.clear(stop, plan.cleared);
    this.overlays.show(plan);
    this.ghost.pose(plan.frames.at(-1), this.contract.scene.floor_m);
    if (!this.milliseconds) performance.mark('plan');
    this.milliseconds = plan.milliseconds;
    panel.status(
      `planned ${(plan.frames.length * TICK_S).toFixed(1)} s ahead ` +
        `in ${(plan.milliseconds / 1000).toFixed(2)} s${this.remark ?? ''}`,
    );
    if (this.route?.finished) this.visit([]);
  }

  notice() {
    if (!(this.now - this.noticedAt < NOTICE_TICKS)) panel.say(`${this.contract.name} notices you`);
    this.noticedAt = this.now;
  }

  // What the planner gets: the shown past, the observer's past, and the visitor's settings.
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
      aim: this.stops.next && [
        this.stops.next[0],
        this.stops.next[2] ? this.rootAt(this.stops.next) : this.observer.animal[1],
        this.stops.next[1],
      ],
      raised: Boolean(this.stops.next?.[2]),
      path: this.route && this.ahead(this.contract.behavior.future_frames),
      ...changes,
    };
  }

  // Where the drawn path leads from here, a place a tick.
  ahead(count) {
    const { pace_m_s: pace, standing_m: standing } = this.contract.agent;
    const [before, here] = this.timeline.past(2);
    this.route.advance([here[0], here[2]]);
    const speed = Math.min(pace, Math.hypot(here[0] - before[0], here[2] - before[2]) / TICK_S);
    return this.route.ahead(Array.from(here.slice(0, 3)), speed, pace, standing, count);
  }

  draw() {
    const { floor_m: floor } = this.contract.scene;
    const frame = this.timeline.at(this.now);
    const root = rootOf(frame);
    this.observer.animal = root.slice(0, 3);
    this.animal.pose(frame, this.groundAt(root));
    this.outline.visible = Boolean(this.state.outline);
    if (this.outline.visible) this.outline.pose(frame, floor);
    this.overlays.follow(root);
    this.ghost.visible = Boolean(this.overlays.plan) && Boolean(this.state.goals);
    const recorded = this.replaying && this.clips.frame(this.replaying, this.replayTick);
    this.recorded.visible = Boolean(recorded);
    if (recorded) this.recorded.pose(recorded, this.groundAt(recorded));
    this.observer.figure.visible = this.state.view !== 'you' && !this.headset.presenting;
    this.frames = (this.frames ?? 0) + 1;
    if (this.frames % (this.room.software ? 6 : 3) === 0) this.drawMap(root, recorded);
    this.room.reveal(root.slice(0, 3));
    this.room.render();
    if (this.frames === 1) performance.mark('animal');
    if (!this.headset.presenting) this.drawTags(root, recorded);
  }

  // The height of the surface that carries an animal there: the floor's, or that of the furniture it is on.
  groundAt(point) {
    const {
      scene: { floor_m: floor },
      volume: { voxel_m: voxel },
    } = this.contract;
    const top =
      this.support
        .tops(point[0], point[2])
        .filter((height) => height < point[1])
        .at(-1) ?? floor;
    return top < floor + 1.5 * voxel ? floor : (this.room.surfaceBelow(point) ?? top);
  }

  drawTags(root, recorded) {
    const above = (x, y, z, lift) => this.room.orbit.target.clone().set(x, y + lift, z);
    const notices =
      this.noticedAt !== undefined && this.now - this.noticedAt < NOTICE_TICKS && this.now >= this.noticedAt;
    this.tags.put(
      'simulated',
      `${recorded ? 'simulated' : this.contract.name}${notices ? ' notices you' : ''}`,
      above(root[0], root[1], root[2], 0.2),
    );
    this.tags.put(
      'recorded',
      recorded ? (this.replaying.opened ? 'take' : 'recorded') : '',
      recorded ? above(recorded[0], recorded[1], recorded[2], 0.2) : null,
    );
    this.tags.put(
      'observer',
      this.state.view === 'you' ? '' : 'you',
      above(
        this.observer.place[0],
        this.contract.scene.floor_m,
        this.observer.place[1],
        this.observer.eye + 0.1,
      ),
    );
    const { left } = this.stops;
    for (let i = 0; i < MOST_STOPS; i++)
      this.tags.put(
        `stop ${i + 1}`,
        left.length > 1 && i < left.length ? String(i + 1) : '',
        left[i] && above(left[i][0], this.contract.scene.floor_m + (left[i][2] ?? 0), left[i][1], 0.08),
      );
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
      commands: this.route ? [this.route.at(this.route.length)] : this.stops.left,
      recorded,
    });
  }
}

const simulator = new Simulator();
simulator.open().then(
  () => {
    window.ats = api(simulator);
  },
  (error) => {
    panel.sorry(
      `Something went wrong while opening: ${error.message}`,
      'Reload the page; if it stays, build the simulator again.',
    );
    console.error(error);
  },
);
