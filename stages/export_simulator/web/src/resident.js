// One animal of the home: its body, what was recorded of it, its life since the last start, and what the
// visitor wants of it. The simulator lets time pass for all of them.

import * as assets from './assets.js';
import { Animal } from './animal.js';
import { clearanceOf } from './avoidance.js';
import { FreeSpace } from './clearing.js';
import { Clips } from './clips.js';
import { Overlays } from './overlays.js';
import { distance } from './path_encoding.js';
import { rotate } from './rigid.js';
import { AWAY } from './state.js';
import { Stops } from './stops.js';
import { Support } from './support.js';
import { Take } from './take.js';
import { Timeline, rootOf } from './timeline.js';

export const TICK_S = 0.1;
const NOTICE_TICKS = 20; // how long is shown that it noticed the person
// a click on furniture counts where a recorded root was this near, level and upright
const BEEN_M = [0.45, 0.12];
const AVOID_TICKS = 12; // so far ahead a plan is checked for the bodies of others
const APPROACH_M = 0.002; // per tick, towards a body that is too near already: paths are not smoother
const SEEN_TICKS = 16; // of the person, remembered
export const COLORS = [0xc8722b, 0x8a5aa8, 0x3f8f8a, 0xb04a5a]; // of animals on the map and in outlines

export class Resident {
  // home: the simulator, with {room, observer, state, now, residents}.
  static async open(home, contract, index) {
    const resident = new Resident();
    const prefix = contract.assets ?? '';
    Object.assign(resident, { home, contract, index, prefix, name: contract.name, does: '' });
    resident.clips = new Clips(contract, await assets.floats(`${prefix}clips`));
    resident.model = await assets.bytes(`${prefix}agent`);
    resident.animal = (await Animal.parse(resident.model)).addTo(home.room.scene);
    resident.outline = resident.animal.outline(0xf08a3c).addTo(home.room.scene);
    resident.ghost = resident.animal.ghost(0xc8722b, 0.16).addTo(home.room.scene);
    resident.recorded = resident.animal.ghost(0x6d675e, 0.6).addTo(home.room.scene);
    resident.recorded.visible = resident.ghost.visible = resident.outline.visible = false;
    const { floor_m: floor } = contract.scene;
    resident.overlays = new Overlays(home.room.scene, floor, contract.agent.root_height_m[0] - floor);
    resident.allowed = await assets.bytes(`${prefix}allowed`);
    resident.occupancy = await assets.bytes(`${prefix}occupancy`);
    resident.detour = null;
    resident.support = new Support(contract.volume, resident.allowed);
    resident.space = new FreeSpace(contract.volume, resident.allowed);
    resident.place = [0, floor, 0];
    resident.clearance = clearanceOf(contract.behavior.agent_from_bone_rest);
    return resident;
  }

  async addSplats() {
    const body = await assets.bytes(`${this.prefix}agent-splats`);
    if (!body) return;
    const skin = await assets.bytes(`${this.prefix}agent-skin`);
    await this.animal.addSplats(body, skin, this.contract.agent.rest, this.home.room.scene);
  }

  get count() {
    return this.contract.behavior.past_frames;
  }

  get present() {
    return this.does !== AWAY;
  }

  // The clip that it replays instead of living, if it does.
  get clip() {
    return this.clips.list.find((clip) => clip.name === this.does) ?? null;
  }

  get selected() {
    return this.home.selected === this;
  }

  get others() {
    return this.home.residents.filter((other) => other !== this && other.present);
  }

  // Begin at a moment of its clips; the person has stood where it stands.
  begin(moment) {
    this.take = new Take();
    this.timeline = this.timed(moment.frames);
    this.turnNumber = 0;
    this.planStart = 0;
    this.waiting = false;
    this.urgent = true;
    this.noticedAt = undefined;
    this.overlays.plan = null;
    this.overlays.refresh();
    this.place = moment.frames.at(-1).slice(0, 3);
    this.stops = new Stops();
    this.route = null;
    this.intentEnd = 0;
    this.epoch = (this.epoch ?? 0) + 1;
    if (this.clip) this.replay(this.clip.name === moment.clip.name ? moment.last : this.count - 1);
  }

  // A line in time whose blends of plans stay where plans do.
  timed(past, tick) {
    return new Timeline(past, this.contract.replanning.blend_frames, tick, (place) =>
      this.whereAllowed(place),
    );
  }

  whereAllowed(place) {
    const { avoid_solid: kept } = this.contract.behavior.sampling;
    return kept && this.home.state.scene ? this.space.cleared(place) : place;
  }

  // Live, replay a clip, or be away, from now on.
  change(does) {
    if (this.does === does) return;
    this.does = does;
    this.epoch += 1;
    this.waiting = false;
    this.urgent = true;
    this.overlays.plan = null;
    this.overlays.refresh();
    this.timeline = this.timed(this.timeline.past(this.count), Math.floor(this.home.now));
    if (this.clip) this.replay(this.count - 1);
  }

  // Furniture has been moved: plan anew, and wait for that plan where the one that is followed would cross it.
  rearranged(support, detour) {
    Object.assign(this, { support, detour, space: new FreeSpace(support.volume, support.allowed) });
    if (!this.timeline) return;
    this.epoch += 1;
    this.waiting = false;
    this.urgent = true;
    const { now } = this.home;
    const ahead = Array.from({ length: Math.ceil(this.timeline.ticksLeft(now)) }, (_, i) =>
      this.timeline.at(now + i + 1),
    );
    if (!this.clip && ahead.length && this.detour?.blocks(ahead, this.timeline.at(now)))
      this.timeline.hold(now);
  }

  // Follow the clip from a tick of it to its end.
  replay(tick) {
    const { clip, clips } = this;
    const frames = (from, to) =>
      Array.from({ length: to - from }, (_, i) => clips.frame(clip, Math.max(0, from + i)));
    const now = Math.floor(this.home.now);
    const last = Math.min(tick, clip.count - 2);
    this.timeline = this.timed(frames(last + 1 - this.count, last + 1), now);
    this.timeline.follow(now, frames(last + 1, clip.count), now);
  }

  // Forget the person's walk: it has stood here for a while.
  settle() {
    this.seen = Array.from({ length: SEEN_TICKS }, () => this.pose);
  }

  // The phone's pose: this animal is in its view.
  get pose() {
    return this.home.observer.pose(this.home.observer.place, this.place);
  }

  // A tenth of a second has passed. Returns whether it has arrived at a goal.
  tick() {
    this.seen.push(this.pose);
    if (this.seen.length > SEEN_TICKS) this.seen.shift();
    const { plan } = this.overlays;
    this.take.add(this.timeline.at(this.home.now), this.pose, plan?.goals[plan.chosen]);
    const arrived = this.stops.visit(this.place);
    this.urgent ||= arrived;
    return arrived;
  }

  // The bodies that it must not walk into, [x, z] each.
  get bodies() {
    return [this.home.observer.place, ...this.others.map(({ place }) => [place[0], place[2]])];
  }

  // Whether the next moment would lead into somebody's body, or into furniture that was moved: then the animal
  // waits for a plan around it.
  wouldMeet(next) {
    if (this.clip) return false;
    const [here, there] = [this.timeline.at(this.home.now), this.timeline.at(next)];
    const end = this.timeline.plans.at(-1)?.frames.at(-1) ?? there;
    if (this.home.state.scene && this.detour?.crosses(here, there, this.detour.exempt(here, end)))
      return true;
    return this.bodies.some(([x, z]) => {
      const [gap, then] = [here, there].map((frame) => Math.hypot(frame[0] - x, frame[2] - z));
      return then < Math.min(this.clearance - 0.05, gap - APPROACH_M * (next - this.home.now));
    });
  }

  // Whether to ask for a plan: the one that is followed ends, or was made before somebody moved noticeably.
  // Replanned at every step, the goal would switch mid-walk; only a visitor's commands are replanned at once.
  get due() {
    const { now, state, residents } = this.home;
    const {
      reaction_frames: soonest,
      commitment_frames: kept,
      blend_frames: fade,
    } = this.contract.replanning;
    if (this.clip) return this.timeline.ticksLeft(now) <= 0;
    if (this.urgent) return true;
    // one worker plans for all
    const thinking = residents.length * ((this.milliseconds ?? 0) / 1000 / TICK_S) * state.speed;
    if (this.timeline.ticksLeft(now) <= fade + thinking) return true;
    if (now - this.planStart >= soonest && this.personMoved) return true;
    if (now - this.planStart < kept) return false;
    return Boolean(this.stops.next || this.route || this.bodyInTheWay || this.othersMoved);
  }

  // Whether the person has moved noticeably since the animal made its plan.
  get personMoved() {
    const here = this.pose;
    return Boolean(this.home.state.observer) && this.movedNoticeably(here, this.noticed);
  }

  // The same of the other animals; one that was not there has moved.
  get othersMoved() {
    return (
      Boolean(this.home.state.companions) &&
      this.others.some((other) => this.movedNoticeably(other.place, this.company.get(other)))
    );
  }

  movedNoticeably(here, before) {
    const { observer_motion_ratio: ratio } = this.contract.replanning;
    return !before || distance(here, before) > ratio * distance(here, this.place);
  }

  // Whether the plan leads nearer to somebody's body than it may, and nearer than it is.
  get bodyInTheWay() {
    const { now } = this.home;
    const ahead = Array.from({ length: AVOID_TICKS }, (_, i) => this.timeline.at(now + i + 1));
    return this.bodies.some(([x, z]) => {
      const gap = (frame) => Math.hypot(frame[0] - x, frame[2] - z);
      const reach = Math.min(this.clearance, gap(this.timeline.at(now))) - 0.02;
      return ahead.some((frame) => gap(frame) < reach);
    });
  }

  // Ask for a plan where one is due, and follow it; null where none came.
  async plan(planner) {
    if (!this.present || this.waiting || !this.due) return null;
    if (this.clip) this.replay(this.count - 1);
    if (this.clip || !planner) return null;
    const { home } = this;
    if (this.timeline.plans.length && home.state.interactivity > 0 && this.personMoved) this.notice();
    this.waiting = true;
    this.urgent = false;
    const epoch = this.epoch;
    const start = Math.floor(home.now);
    const intent = this.intent(start);
    this.planStart = home.now;
    this.noticed = this.pose;
    this.company = new Map(this.others.map((other) => [other, [...other.place]]));
    const stop = this.stops.next;
    let plan;
    try {
      plan = await planner.plan(this.question({ intent, seed: home.state.seed * 1009 + this.turnNumber++ }));
    } catch (error) {
      if (epoch === this.epoch) throw error;
      return null;
    }
    if (epoch !== this.epoch) return null;
    this.waiting = false;
    this.timeline.follow(start, plan.frames, home.now);
    this.goal = plan.goals[plan.chosen];
    if (!intent) this.intentEnd = start + plan.frames.length;
    if (plan.cleared) this.stops.clear(stop, plan.cleared);
    this.overlays.show(plan);
    this.ghost.pose(plan.frames.at(-1), this.contract.scene.floor_m);
    this.milliseconds = plan.milliseconds;
    return plan;
  }

  // Where an animal beside others intends to be from a tick on: what is left of its plan, moved with the one that
  // its goal is beside. Others move all the time; without it, every plan would have a goal of its own. null
  // after the plan's horizon, for a visitor's command, where the visitor has moved, and for an animal that is alone.
  intent(start) {
    const left = this.intentEnd - start;
    const { blend_frames: fade, companion_radius_m: radius } = this.contract.replanning;
    if (!this.others.length || !this.timeline.plans.length || !(left > fade)) return null;
    if (this.stops.next || this.route || !this.goal || this.personMoved) return null;
    const [nearest] = [...(this.company ?? [])].sort(
      ([, a], [, b]) => distance(a, this.goal) - distance(b, this.goal),
    );
    const beside = nearest && distance(nearest[1], this.goal) < radius;
    const moved = [0, 1, 2].map((axis) => (beside ? nearest[0].place[axis] - nearest[1][axis] : 0));
    return Array.from({ length: left }, (_, i) => {
      const place = rootOf(this.timeline.at(start + i + 1)).slice(0, 3);
      return this.whereAllowed(place.map((value, axis) => value + (moved[axis] * i) / left));
    });
  }

  notice() {
    if (!this.notices) this.home.say(`${this.name} notices you`);
    this.noticedAt = this.home.now;
  }

  get notices() {
    const { now } = this.home;
    return this.noticedAt !== undefined && now - this.noticedAt < NOTICE_TICKS && now >= this.noticedAt;
  }

  // What the planner gets: the shown past, that of the person and of the others, and the visitor's settings.
  question(changes = {}) {
    const { state } = this.home;
    const { next } = this.stops;
    return {
      animal: this.index,
      past: this.timeline.past(this.count),
      observer: this.seen.slice(-this.count),
      companions: state.companions
        ? this.others.map((other) =>
            other.timeline.past(this.count).map((row) => Array.from(row.slice(0, 3))),
          )
        : [],
      keep: { scene: state.scene, observer: state.observer, past: state.past, goal: state.goal },
      interactivity: state.interactivity,
      company: this.others.map(({ name }) => this.home.scales[name]),
      samples: state.samples,
      steps: state.steps,
      aim: next && [next[0], next[2] ? this.rootAt(next) : this.place[1], next[1]],
      raised: Boolean(next?.[2]),
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
    const { standing_m: standing } = this.contract.agent;
    return point[2] ? this.support.carried([point[0], point[2] + standing, point[1]], false) : standing;
  }

  // The height of the surface that carries it there: the floor's, or that of the furniture it is on.
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
    return top < floor + 1.5 * voxel ? floor : (this.home.room.surfaceBelow(point) ?? top);
  }

  // Show it as it is now, and its plan where it is the one that the visitor has chosen. recorded: the frame
  // of the clip beside it, or null.
  draw(recorded) {
    const { state, now } = this.home;
    const frame = this.timeline.at(now);
    const root = rootOf(frame);
    this.place = root.slice(0, 3);
    this.animal.shown = this.present;
    if (this.present) this.animal.pose(frame, this.groundAt(root));
    const hidden = this.home.room.cutaway.hidden && state.view !== 'you';
    this.outline.visible = this.present && this.selected && (Boolean(state.outline) || hidden);
    if (this.outline.visible) this.outline.pose(frame, this.contract.scene.floor_m);
    this.overlays.group.visible = this.selected && this.present;
    this.overlays.follow(root);
    this.ghost.visible = this.overlays.group.visible && Boolean(this.overlays.plan) && Boolean(state.goals);
    this.recorded.visible = Boolean(recorded);
    if (recorded) this.recorded.pose(recorded, this.groundAt(recorded));
    return root;
  }

  // Where it is on the map, and where it looks.
  get mark() {
    const root = rootOf(this.timeline.at(this.home.now));
    const nose = rotate(root.slice(3), [0, 0, 1]);
    return { x: root[0], z: root[2], heading: Math.atan2(nose[0], nose[2]), color: COLORS[this.index % 4] };
  }
}
