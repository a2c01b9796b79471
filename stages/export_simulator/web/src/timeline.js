// The animal's motion as one line in time: what was shown, the plan being followed, and the cross-fade into
// the next. Ticks are 10 Hz frames; a frame holds the root's row and then one row per bone.

import { ROW, blend } from './rigid.js';

const HOLD_TICKS = 10; // an animal that has to wait stands so long, unless a plan comes before

export class Timeline {
  // Start from frames of the past; the last of them is this tick. fade: over how many ticks a plan is blended
  // in. clear: moves a place to where the root may be.
  constructor(past, fade, tick = 0, clear = (point) => point) {
    Object.assign(this, { fade, clear });
    this.history = past.map((frame) => Float32Array.from(frame));
    this.lastTick = tick;
    this.base = this.history.at(-1);
    this.plans = [];
  }

  // The frames the next plan continues, oldest first.
  past(count) {
    return this.history.slice(-count);
  }

  // Follow frames[0] at tick start + 1, and so on; what was followed until `now` fades out.
  follow(start, frames, now) {
    const faded = this.plans.findLastIndex((plan) => this.share(plan, now) >= 1);
    this.plans = [...this.plans.slice(Math.max(0, faded)), { start, frames, since: now }];
  }

  // Stand still from now on, until another plan is followed.
  hold(now) {
    const pose = this.at(now);
    this.plans = [{ start: now, frames: Array(HOLD_TICKS).fill(pose), since: -Infinity }];
  }

  ticksLeft(now) {
    const plan = this.plans.at(-1);
    return plan ? plan.start + plan.frames.length - now : 0;
  }

  // The pose at a time: each plan is blended over the one before it. Both are where the root may be, what is
  // between them need not be: it is moved there at every tick, as in Python, and in between along with them.
  at(now) {
    const pose = this.blended(now);
    if (this.plans.length < 2 || this.share(this.plans.at(-1), now) >= 1) return pose;
    const [before, after] = [this.pushed(Math.floor(now)), this.pushed(Math.ceil(now))];
    for (let axis = 0; axis < 3; axis++)
      pose[axis] += before[axis] + (now - Math.floor(now)) * (after[axis] - before[axis]);
    return pose;
  }

  blended(now) {
    let pose = this.base;
    for (const plan of this.plans) pose = blend(pose, sample(plan, now), this.share(plan, now));
    return pose;
  }

  // How far a plan has faded in, 0 to 1, as in Python: after `fade` more ticks only it is seen.
  share(plan, now) {
    return Math.min(1, Math.max(0, (now - plan.since) / (this.fade + 1)));
  }

  // How far the root of a blend is moved at a tick.
  pushed(tick) {
    const place = Array.from(this.blended(tick).subarray(0, 3));
    const free = this.clear(place);
    return place.map((value, axis) => free[axis] - value);
  }

  // Write down every tick that has passed, so that the next plan knows its past.
  record(now) {
    while (this.lastTick + 1 <= now) {
      this.lastTick += 1;
      this.history.push(Float32Array.from(this.at(this.lastTick)));
      if (this.history.length > 64) this.history.shift();
    }
  }
}

function sample(plan, now) {
  const place = Math.min(plan.frames.length - 1, Math.max(0, now - plan.start - 1));
  const index = Math.floor(place);
  const next = Math.min(index + 1, plan.frames.length - 1);
  return blend(plan.frames[index], plan.frames[next], place - index);
}

export const rootOf = (frame) => Array.from(frame.subarray(0, ROW));
