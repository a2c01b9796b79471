// The page: unpack, build the room, let the animal live, plan ahead in a worker, and listen to the visitor.

import * as assets from './assets.js';
import { api } from './api.js';
import { Controls } from './controls.js';
import { Film } from './film.js';
import { filledFloor, filledPlaces } from './floor.js';
import { Headset } from './headset.js';
import { Minimap } from './minimap.js';
import { Mover } from './mover.js';
import { arrays } from './npz.js';
import { Observer } from './observer.js';
import * as panel from './panel.js';
import { Planner } from './planner.js';
import { Resident, TICK_S } from './resident.js';
import { Room } from './room.js';
import { Route } from './route.js';
import {
  doingsText,
  readDoings,
  readMoves,
  readPlaces,
  readPoint,
  readScales,
  readState,
  scalesText,
  writeState,
} from './state.js';
import { Stops, meters, placesText } from './stops.js';
import { Tags } from './tags.js';
import { fileStem, save } from './take.js';
import { rootOf } from './timeline.js';

const AGAIN_MS = 1000; // after a plan that failed, the next is asked for
const MOST_STOPS = 9;
const CALL_M = 0.6; // before the person, on the animal's side, an animal stops that is called
const RAISED_M = 0.3; // a click on furniture belongs to a top that is no further up or down

class Simulator {
  async open() {
    this.contract = await assets.json('simulator');
    panel.progress(0.15, 'opening the room');
    this.room = new Room(document.getElementById('view'), this.contract);
    await this.room.addMesh(await assets.bytes('room'));
    panel.progress(0.3, 'loading the animal');
    this.observer = new Observer(this.contract);
    this.room.scene.add(this.observer.figure);
    this.residents = [];
    for (const [index, contract] of (this.contract.animals ?? [this.contract]).entries())
      this.residents.push(await Resident.open(this, contract, index));
    const { state, ignored } = this.addressed;
    this.state = state;
    this.now = 0;
    this.appoint();
    this.tags = new Tags(this.room.camera);
    this.film = new Film(this.room.canvas);
    this.room.frameRoom(
      this.selected.clips.moment(this.state.seed, this.selected.count).frames.at(-1).slice(0, 3),
    );
    this.map = new Minimap(document.getElementById('minimap'), this.room.picture(256), this.room.heading());
    for (const resident of this.residents)
      resident.clips.each((frame, camera) => {
        this.map.visit('animal', frame[0], frame[2], 0.25);
        this.map.visit('observer', camera[0], camera[2], 0.25);
      });
    const [{ contract, allowed }] = this.residents;
    const filled = filledPlaces(contract.volume, allowed);
    if (filled.length)
      this.room.scene.add(filledFloor(filled, contract.volume.voxel_m, this.contract.scene.floor_m));
    this.mover = new Mover(this);
    this.connect();
    const lost = this.furnish();
    this.reset();
    panel.progress(1, 'ready');
    panel.ready();
    this.complain([...ignored, ...lost]);
    if (this.contract.scene.warning) panel.warn(this.contract.scene.warning);
    this.last = performance.now();
    this.room.renderer.setAnimationLoop(() => this.frame());
    // the animal is seen while what it plans with is loaded
    this.planner = await Planner.open(this.residents, (share) =>
      panel.status(`loading the behavior model, ${Math.round(100 * share)} %`),
    );
    this.mover.inform();
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
    this.mover.view.moveSplats(this.mover.moves);
    for (const resident of this.residents) await resident.addSplats();
  }

  // Move the furniture that the state says. Returns what of it means nothing here.
  furnish() {
    const lost = this.mover.read(this.state.moved ? readMoves(this.state.moved) : []);
    return lost ? [`moved=${lost} of the moved pieces`] : [];
  }

  // Furniture has been moved, or put back.
  rearranged(any) {
    panel.showMoved(any);
    writeState(this.state, this.contract);
    this.map.paint(this.room.picture(256));
  }

  // Save a file; what it does not keep is said.
  keep(blob, name) {
    save(blob, name);
    if (this.state.moved) panel.help('The furniture you moved is not in this file: the link keeps it.', 6);
  }

  // Save what the selected animal has done; a model without keys would be no valid file.
  keepTake(written, ending) {
    const { take, name } = this.selected;
    if (!take.rows.length) return panel.help(`${name} has done nothing yet that can be kept.`, 4);
    this.keep(written(take), `${this.fileName}.${ending}`);
  }

  // What the address says.
  get addressed() {
    return readState(this.contract, (name) => this.resident(name).clips.list);
  }

  // The resident of a name, by default the first.
  resident(name) {
    return this.residents.find((resident) => resident.name === name) ?? this.residents[0];
  }

  // Let the state say who is selected and what everybody does. A clip of another animal ends.
  appoint() {
    const doings = readDoings(this.state.does, this.contract) ?? {};
    this.selected = this.resident(this.state.animal);
    const { list } = this.selected.clips;
    if (!list.some(({ name }) => name === this.state.replay)) this.state.replay = '';
    panel.showClips(list, this.state.replay);
    for (const resident of this.residents) {
      const does = doings[resident.name] ?? '';
      if (resident.timeline) resident.change(does);
      else resident.does = does;
    }
  }

  // What one of the animals does from now on: '' lives, else it is away or replays a clip.
  employ(name, does) {
    this.state.does = doingsText({ ...readDoings(this.state.does, this.contract), [name]: does });
    this.changed('does');
  }

  // How strongly the others react to each of the animals, by name.
  get scales() {
    return readScales(this.state.guidance, this.contract);
  }

  // To one of them from now on.
  guide(name, scale) {
    this.state.guidance = scalesText({ ...this.scales, [name]: scale }, this.contract);
    this.panel.refresh();
    this.changed('guidance');
  }

  connect() {
    this.playing = true;
    this.panel = panel.buildPanel(this.state, this.contract, {
      employ: (name, does) => this.employ(name, does),
      guide: (name, scale) => this.guide(name, scale),
      change: (key) => this.changed(key),
      play: () => this.play(),
      reset: () => this.reset(),
      free: () => this.visit([]),
      call: () => this.call(),
      hold: (tool) => this.hold(tool),
      undo: () => this.mover.undo(),
      restore: () => this.mover.restore(),
      csv: () => this.keepTake((take) => take.csv(), 'csv'),
      glb: () => this.keepTake((take) => take.glb(this.selected.model), 'glb'),
      film: () => this.shoot(),
      toml: () => this.keep(this.selected.stops.toml, `${this.fileName}_subgoals.toml`),
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
      next: () => this.selectNext(),
      how: panel.howTo,
      announce: () => panel.say(this.whereabouts()),
      ...this.mover.hands,
      stroke: (points) => (points ? this.selected.overlays.ask(points) : this.showCommands()),
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
      const { state, ignored } = this.addressed;
      Object.assign(this.state, state);
      this.appoint();
      this.complain([...ignored, ...this.furnish()]);
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
    return `${this.selected.name} is ${Math.hypot(dx, dz).toFixed(1)} meters away, ${side}`;
  }

  play() {
    this.playing = !this.playing;
    panel.showPlaying(this.playing);
  }

  changed(key) {
    if (key === 'animal' || key === 'does') this.appoint();
    writeState(this.state, this.contract);
    for (const { overlays } of this.residents) {
      Object.assign(overlays.layers, { goals: Boolean(this.state.goals), path: Boolean(this.state.path) });
      overlays.refresh();
    }
    this.replaying = this.selected.clips.list.find((clip) => clip.name === this.state.replay) ?? null;
    if (key === 'view') this.room.look(this.state.view, this.eyes(), this.selected.place);
    if (key === 'animal') this.greet();
    if (key === 'does') this.panel.refresh();
    if (['seed', 'replay'].includes(key) || (key === 'animal' && this.replaying)) this.reset();
    else if (!['goals', 'path', 'outline', 'speed', 'view', 'animal', 'does'].includes(key)) this.hurry();
  }

  // The animal that clicks are for has changed.
  greet() {
    this.observer.animal = this.selected.place;
    this.showCommands();
    if (this.state.view !== 'room') this.room.look(this.state.view, this.eyes(), this.selected.place);
    panel.say(`${this.selected.name} is selected`);
  }

  selectNext() {
    if (this.residents.length < 2) return;
    this.state.animal = this.residents[(this.selected.index + 1) % this.residents.length].name;
    this.changed('animal');
    this.panel.refresh();
  }

  // Let everybody plan anew, whatever they intended.
  hurry() {
    for (const resident of this.residents) Object.assign(resident, { urgent: true, intentEnd: 0 });
  }

  say(text) {
    panel.say(text);
  }

  get present() {
    return this.residents.filter(({ present }) => present);
  }

  // Begin at a recorded moment that the seed picks, or where the clip beside begins; the other animals where
  // they were then. The observer stands where the person stood and, beside a clip, walks as the person walked
  // until somebody takes over.
  reset() {
    const { selected } = this;
    const leading = this.replaying ? selected : this.residents[0];
    const moment = this.replaying
      ? leading.clips.beginning(this.replaying, leading.count)
      : this.mover.beginning(this.state.seed, (seed) => leading.clips.moment(seed, leading.count));
    this.replayTick = leading.count - 1;
    this.taken = Boolean(this.state.at);
    this.now = 0;
    for (const resident of this.residents)
      resident.begin(
        resident === leading ? moment : resident.clips.beside(moment, this.state.seed, resident.count),
      );
    this.observer.animal = selected.place;
    this.observer.animals = this.present.map(({ place }) => place);
    this.observer.place = readPoint(this.state.at)?.slice(0, 2) ?? [moment.observer[0], moment.observer[2]];
    this.observer.target = null;
    this.settle();
    const route = readPlaces(this.state.route);
    selected.route = route.length > 1 ? new Route([[selected.place[0], selected.place[2]], ...route]) : null;
    selected.stops = new Stops(
      selected.route ? [] : readPlaces(this.state.aim),
      rootOf(selected.timeline.base),
      (point) => selected.rootAt(point),
    );
    this.showCommands();
    if (this.state.view !== 'room') this.room.look(this.state.view, this.eyes(), selected.place);
  }

  // The person stands here as if for a while.
  settle() {
    for (const resident of this.residents) resident.settle();
    this.observer.step(0, [0, 0], 0);
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
      const top = this.selected.support
        .tops(x, z)
        .sort((a, b) => Math.abs(a - floor - up) - Math.abs(b - floor - up))[0];
      if (
        top === undefined ||
        Math.abs(top - floor - up) > RAISED_M ||
        !this.selected.hasBeenOn(...this.mover.before([x, z], top), top)
      )
        return panel.help(
          `${this.selected.name} has never been up there: click where it can be, or the floor beside.`,
          5,
        );
      point = [x, z, top - floor];
    }
    this.visit(further ? [...this.selected.stops.left, point] : [point]);
  }

  // Come to the person: as near as one comes to a body.
  call() {
    const [x, z] = this.observer.place;
    const { place } = this.selected;
    const [dx, dz] = [place[0] - x, place[2] - z];
    const far = Math.hypot(dx, dz) || 1;
    this.visit([[x + (dx * CALL_M) / far, z + (dz * CALL_M) / far]]);
  }

  // Go to one place after the other, [[x, z], ...]; with none it chooses for itself. What a journey has seen,
  // it keeps.
  visit(points) {
    if (points.length > MOST_STOPS) return panel.help(`${MOST_STOPS} goals at most.`, 4);
    const { selected } = this;
    if (selected.stops.next && points.length > 1) selected.stops.continue(points);
    else
      selected.stops = new Stops(points, rootOf(selected.timeline.at(this.now)), (point) =>
        selected.rootAt(point),
      );
    Object.assign(selected, { route: null, urgent: true, intentEnd: 0 });
    this.showCommands();
  }

  // Walk along a stroke of points [x, z]; a dot is a goal.
  follow(points) {
    this.hold(null);
    if (points.length < 3) return points.length ? this.visit(points.slice(-1)) : this.showCommands();
    const { selected } = this;
    selected.stops = new Stops();
    selected.route = new Route([[selected.place[0], selected.place[2]], ...points]);
    this.showCommands();
    selected.urgent = true;
  }

  // Take a tool in hand, 'pen' or 'pins', or put away the one that is held.
  hold(tool) {
    if (this.mover.held) this.mover.cancel();
    this.controls.cancel();
    this.controls.tool = this.controls.tool === tool ? null : tool;
    panel.showTool(this.controls.tool);
  }

  // The visitor's goals or path: on the floor, in the address, and as a way out of it.
  showCommands() {
    const { stops, route, overlays } = this.selected;
    this.state.aim = placesText(stops.left);
    this.state.route = route ? placesText(route.corners) : '';
    writeState(this.state, this.contract);
    panel.showCommands(Boolean(stops.left.length || route), stops.points.length);
    overlays.ask(route?.points ?? null, stops.left);
  }

  get fileName() {
    return `${fileStem(this.selected.name)}_seed${this.state.seed}`;
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
    const { blob, ending } = await this.film.stop();
    save(blob, `${this.fileName}.${ending}`);
  }

  // A take of `stages.simulate` plays beside, as a recorded clip does.
  async openTake(file) {
    try {
      const clip = this.selected.clips.add(
        file.name.replace(/\.npz$/, ''),
        await arrays(new Uint8Array(await file.arrayBuffer())),
      );
      this.state.replay = clip.name;
      panel.showClips(this.selected.clips.list, clip.name);
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
      if (this.present.every(({ timeline }) => timeline.plans.length))
        this.advance(seconds * this.state.speed);
      // no time has passed: who has come since then has always stood here
      else if (this.walk(seconds)) this.settle();
      for (const resident of this.residents) this.plan(resident);
      if (!this.headset.presenting) this.room.attend(this.selected.place, seconds, this.eyes());
    }
    const [turn, closer] = this.controls.turning();
    if ((turn || closer) && !this.headset.presenting)
      this.room.turn(1.2 * turn * seconds, Math.exp(closer * seconds));
    this.draw();
  }

  // Let seconds pass, for animals and observer; never past what is planned: wait for the next plan rather
  // than freeze in mid-step.
  advance(seconds) {
    const { present } = this;
    const left = Math.min(...present.map(({ timeline }) => timeline.ticksLeft(this.now)));
    const end = this.now + Math.min(seconds / TICK_S, Math.max(0, left));
    while (this.now < end) {
      const next = Math.min(end, Math.floor(this.now) + 1);
      for (const resident of present)
        if (resident.wouldMeet(next)) {
          resident.timeline.hold(this.now);
          resident.urgent = true;
        }
      this.walk((next - this.now) * TICK_S);
      this.now = next;
      if (Number.isInteger(next)) this.tick();
    }
    for (const { timeline } of present) timeline.record(this.now);
  }

  tick() {
    this.map.visit('observer', ...this.observer.place);
    this.replayTick += 1;
    for (const resident of this.present) {
      this.map.visit('animal', resident.place[0], resident.place[2]);
      if (!resident.tick()) continue;
      panel.say(`${resident.name} has arrived`);
      if (resident.selected) this.showCommands();
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
    const camera = this.selected.clips.camera(this.replaying, this.replayTick);
    this.observer.place = [camera[0], camera[2]];
    this.observer.step(0, [0, 0], 0);
  }

  rememberPlace() {
    this.state.at = this.observer.place.map(meters).join(',');
    writeState(this.state, this.contract);
    this.moved = false;
  }

  async plan(resident) {
    const { epoch } = resident;
    try {
      const plan = await resident.plan(this.planner);
      if (!plan) return;
      if (!this.milliseconds) performance.mark('plan');
      this.milliseconds = plan.milliseconds;
      panel.status(
        `planned ${(plan.frames.length * TICK_S).toFixed(1)} s ahead ` +
          `in ${(plan.milliseconds / 1000).toFixed(2)} s${this.remark ?? ''}`,
      );
      if (!resident.route?.finished) return;
      resident.route = null;
      if (resident.selected) this.visit([]);
    } catch (error) {
      panel.status(`cannot plan (${error.message}): trying again; if that does not help, reload the page`);
      setTimeout(() => {
        if (epoch === resident.epoch) Object.assign(resident, { waiting: false, urgent: true });
      }, AGAIN_MS);
    }
  }

  draw() {
    const { selected } = this;
    const recorded = this.replaying && selected.clips.frame(this.replaying, this.replayTick);
    for (const resident of this.residents) resident.draw(resident === selected ? recorded : null);
    this.observer.animal = selected.place;
    this.observer.animals = this.present.map(({ place }) => place);
    this.observer.figure.visible = this.state.view !== 'you' && !this.headset.presenting;
    this.frames = (this.frames ?? 0) + 1;
    if (this.frames % (this.room.software ? 6 : 3) === 0) this.drawMap(recorded);
    this.room.reveal(selected.place);
    this.room.render();
    if (this.frames === 1) performance.mark('animal');
    if (!this.headset.presenting) this.drawTags(recorded);
  }

  drawTags(recorded) {
    const above = (x, y, z, lift) => this.room.orbit.target.clone().set(x, y + lift, z);
    for (const resident of this.residents) {
      const name = recorded && resident.selected ? 'simulated' : resident.name;
      const text = resident.clip ? `${name}, recorded` : `${name}${resident.notices ? ' notices you' : ''}`;
      this.tags.put(
        resident.selected ? 'simulated' : `resident ${resident.index}`,
        resident.present ? text : '',
        above(...resident.place, 0.2),
      );
    }
    this.tags.put(`resident ${this.selected.index}`, '');
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
    const { left } = this.selected.stops;
    for (let i = 0; i < MOST_STOPS; i++)
      this.tags.put(
        `stop ${i + 1}`,
        left.length > 1 && i < left.length ? String(i + 1) : '',
        left[i] && above(left[i][0], this.contract.scene.floor_m + (left[i][2] ?? 0), left[i][1], 0.08),
      );
  }

  drawMap(recorded) {
    const { overlays, route, stops, place } = this.selected;
    const { plan } = overlays;
    const [x, z] = this.observer.place;
    this.map.draw({
      animals: this.present.map(({ mark }) => mark),
      observer: { x, z, heading: Math.atan2(place[0] - x, place[2] - z) },
      goals: this.state.goals ? plan?.goals : null,
      chosen: plan?.chosen,
      path: this.state.path ? plan?.path : null,
      commands: route ? [route.at(route.length)] : stops.left,
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
