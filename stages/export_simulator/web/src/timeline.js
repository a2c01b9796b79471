// The animal's motion as one line in time: what was shown, the plan being followed, and the cross-fade into the next.
// Ticks are 10 Hz frames; a frame holds the root's row and then one row per bone.

import { ROW, blend } from './rigid.js';

const FADE_TICKS = 4;

export class Timeline {
  constructor(past) {
    this.reset(past);
  }

  // Start from recorded frames; the last of them is tick 0.
  reset(past) {
    this.history = past.map((frame) => Float32Array.from(frame));
    this.lastTick = 0;
    this.plans = [];
  }

  // The frames the next plan continues, oldest first.
  past(count) {
    return this.history.slice(-count);
  }

  // Follow frames[0] at tick start + 1, and so on; the old plan fades out.
  follow(start, frames, now) {
    this.plans = [...this.plans.slice(-1), { start, frames, since: now }];
  }

  ticksLeft(now) {
    const plan = this.plans.at(-1);
    return plan ? plan.start + plan.frames.length - now : 0;
  }

  at(now) {
    if (!this.plans.length) return this.history.at(-1);
    const [first, second] = this.plans;
    if (!second) return this.fadeFrom(this.anchor(first), this.sample(first, now), first, now);
    return this.fadeFrom(this.sample(first, now), this.sample(second, now), second, now);
  }

  // Write down every tick that has passed, so that the next plan knows its past.
  record(now) {
    while (this.lastTick + 1 <= now) {
      this.lastTick += 1;
      this.history.push(Float32Array.from(this.at(this.lastTick)));
      if (this.history.length > 64) this.history.shift();
    }
  }

  anchor(plan) {
    plan.anchor ??= this.history.at(-1);
    return plan.anchor;
  }

  fadeFrom(old, next, plan, now) {
    const share = Math.min(1, Math.max(0, (now - plan.since) / FADE_TICKS));
    if (share >= 1) {
      this.plans = [plan];
      plan.anchor = next;
      return next;
    }
    return blend(old, next, share * share * (3 - 2 * share));
  }

  sample(plan, now) {
    const place = Math.min(plan.frames.length - 1, Math.max(0, now - plan.start - 1));
    const index = Math.floor(place);
    const next = Math.min(index + 1, plan.frames.length - 1);
    return blend(plan.frames[index], plan.frames[next], place - index);
  }
}

export const rootOf = (frame) => Array.from(frame.subarray(0, ROW));
