// From what is perceived to a plan: goal, then path, then body. Counterpart of Sampler in
// pipeline/behavior/planning.py.

import { aroundPerson, clearanceOf } from './avoidance.js';
import { guidanceWeights, guided, sample } from './diffusion.js';
import { normals } from './noise.js';
import { apply, inverse } from './rigid.js';
import { withoutSome } from './senses.js';
import { ARRIVED_M } from './stops.js';
import {
  velocityChannelsAlong,
  distance,
  goalFrom,
  snappedToGoal,
  pathFrom,
  scaledGoal,
} from './path_encoding.js';

// paths drawn at most; of those that stay in the room, the one nearest to what the animal intends is taken
const CANDIDATES = 4;
const SOONEST = 6; // frames that a visitor's goal leaves at least
// a clicked goal further away than this, in deviations of learned goals, is approached in legs
const FURTHEST = 2;

export class Sampler {
  // networks: name -> async (feeds: {name: [values, shape]}) -> Float32Array
  constructor(contract, networks, senses) {
    Object.assign(this, {
      contract: contract.behavior,
      heights: contract.agent.root_height_m,
      pace: contract.agent.pace_m_s,
      networks,
      senses,
    });
    this.frames = this.contract.future_frames;
    this.pathChannels = this.contract.path_encoding.channels;
    this.channels = this.contract.scaling.body_mean.length;
    this.clearance = clearanceOf(this.contract.agent_from_bone_rest);
  }

  // The code with every condition, and the references of guidance: without the observer, then without each
  // companion too, where their scales, `interactivity` and `company`, are not 1.
  async codes(observation, keep, interactivity, company = []) {
    const rows = this.contract.past_frames + this.contract.channels.others.anticipated_frames.length;
    const count = observation.others.length / (10 * rows);
    const perceive = (observer, absent = []) =>
      this.networks.perception({
        scene_grid: [
          observation.sceneGrid,
          [1, this.contract.architecture.scene_channels, ...this.contract.grid.shape],
        ],
        others: [
          observer || count === 1
            ? observation.others
            : withoutSome(observation.others, [0, ...absent], rows),
          [1, count, rows, 10],
        ],
        past: [observation.past, [1, observation.past.length]],
        keep: [Float32Array.of(keep.scene, count === 1 ? observer : 1, keep.past), [1, 3]],
      });
    const full = await perceive(keep.observer);
    const last = observation.past.length / this.contract.past_frames;
    const start = Array.from(observation.past.slice(-last).slice(0, 3));
    const apart = company.some((scale) => scale !== 1);
    const references = [interactivity === 1 && !apart ? full : await perceive(0)];
    for (const [i, scale] of company.entries())
      references.push(scale === 1 ? full : await perceive(0, [i + 1]));
    return { full, start, references };
  }

  // Scaled goals, `count` of them, three numbers each.
  async goals(codes, count, { noise, steps, interactivity, company, method, draw, frame }) {
    const denoise = (code) => (x, t) =>
      this.networks.goal({ x: [x, [count, 3]], ...this.step(count, t, code) });
    const options = { method, count: steps, draw, interactivity, company };
    const drawn = await this.run(denoise, codes, noise, options);
    return frame ? this.goalsCleared(frame, codes.start, drawn) : drawn;
  }

  // Scaled paths [3, frames] towards scaled goals, and others for those that miss it although guidance
  // follows the goal alone.
  async paths(codes, goals, { draw, draws, ...options }) {
    const { keepGoal = 1, commanded = false, interactivity } = options;
    const paths = await this.pathsOnce(codes, goals, options);
    const length = 3 * this.frames;
    for (let i = 1; i < draws && (commanded || (keepGoal && interactivity >= 1)); i++) {
      const off = this.goalErrors(paths, goals, codes.start);
      const again = [...off.keys()].filter((index) => off[index] > 1);
      if (!again.length) break;
      const targets = Float32Array.from(
        again.flatMap((index) => Array.from(goals.subarray(3 * index, 3 * index + 3))),
      );
      const others = await this.pathsOnce(codes, targets, {
        ...options,
        noise: draw(this.pathChannels * this.frames * again.length),
      });
      const closer = this.goalErrors(others, targets, codes.start);
      again.forEach((index, other) => {
        if (closer[other] < off[index])
          paths.set(others.subarray(other * length, (other + 1) * length), index * length);
      });
    }
    return paths;
  }

  // How far from their goals paths end, in parts of what still counts as there: more than 1 does not.
  goalErrors(paths, goals, start) {
    const { goal_tolerance_m: least, goal_tolerance_share: share } = this.contract.path_encoding;
    const length = 3 * this.frames;
    return Array.from({ length: goals.length / 3 }, (_, i) => {
      const [goal, end] = [
        this.goal(goals, i),
        this.positions(paths.subarray(i * length, (i + 1) * length)).at(-1),
      ];
      return distance(end, goal) / Math.max(least, share * distance(goal, start));
    });
  }

  // A scaled path towards each scaled goal. The reference of the guidance sees neither observer nor goal, but
  // a goal that the visitor has set is not taken away.
  async pathsOnce(
    codes,
    goals,
    { noise, steps, interactivity, company, frame, keepGoal = 1, commanded = false },
  ) {
    const count = goals.length / 3;
    const denoise = (code, keep) => (x, t) =>
      this.networks.path({
        x: [x, [count, this.pathChannels, this.frames]],
        ...this.step(count, t, code),
        control: [goals, [count, 3]],
        keep: [new Float32Array(count).fill(keep), [count, 1]],
      });
    const correct = frame && ((clean) => this.pathsCleared(frame, codes.start, clean));
    const drawn = await this.run(
      (code, number) => denoise(code, number ? Number(commanded) : keepGoal),
      codes,
      noise,
      { method: 'dpm_solver', count: steps, interactivity, company, correct },
    );
    const snapped = this.contract.sampling.snap_to_goal ? keepGoal * Math.min(interactivity, 1) : 0;
    const pull = commanded ? 1 : snapped;
    return this.snappedPaths(drawn, goals, codes.start, pull);
  }

  // Scaled goals, moved to where the animal may rest, on what carries it.
  goalsCleared(frame, start, scaled) {
    const [egoFromWorld, from] = [inverse(frame), apply(frame, start)];
    return Float32Array.from(
      this.goalsInWorld(frame, scaled).flatMap((goal) => {
        const [x, y, z] = this.senses.turnedFree(goal, from);
        return Array.from(
          this.scaled(apply(egoFromWorld, [x, this.senses.support.carried([x, y, z], false), z])),
        );
      }),
    );
  }

  // The places that sampled channels lead to: strides from `start` on, or positions, as in the paper.
  placesOf(drawn, start) {
    const { architecture, scaling, path_encoding: encoding, rate_hz: rate } = this.contract;
    return architecture.encoding === 'positions'
      ? this.positions(drawn)
      : pathFrom(drawn, this.frames, scaling.velocity_std, start, rate, encoding);
  }

  // Sampled channels that lead along other places.
  channelsAlong(drawn, start, places) {
    const { architecture, scaling, path_encoding: encoding, rate_hz: rate } = this.contract;
    return architecture.encoding === 'positions'
      ? this.scaledPath(places)
      : velocityChannelsAlong(drawn, this.frames, scaling.velocity_std, start, places, rate, encoding);
  }

  // Sampled channels of paths, moved to where the animal may be.
  pathsCleared(frame, start, scaled) {
    const [egoFromWorld, length] = [inverse(frame), this.pathChannels * this.frames];
    const out = new Float32Array(scaled.length);
    for (let at = 0; at < scaled.length; at += length) {
      const mine = scaled.subarray(at, at + length);
      const moved = this.placesOf(mine, start).map((place) =>
        apply(egoFromWorld, this.senses.space.cleared(apply(frame, place))),
      );
      out.set(this.channelsAlong(mine, start, moved), at);
    }
    return out;
  }

  // Scaled places [3, frames] that sampled channels lead to, snapped to scaled goals.
  snappedPaths(drawn, goals, start, pull) {
    const length = this.pathChannels * this.frames;
    const each = Array.from({ length: goals.length / 3 }, (_, i) => {
      const path = this.placesOf(drawn.subarray(i * length, (i + 1) * length), start);
      return this.scaledPath(snappedToGoal(path, start, this.goal(goals, i), pull));
    });
    return Float32Array.from(each.flat());
  }

  // The i-th of scaled goals in meters, and back.
  goal(scaled, i = 0) {
    return goalFrom(
      scaled.subarray(3 * i, 3 * i + 3),
      this.contract.scaling.goal_std,
      this.contract.path_encoding,
    );
  }

  scaled(goal) {
    return scaledGoal(goal, this.contract.scaling.goal_std, this.contract.path_encoding);
  }

  // Places as the body's control: scaled frame by frame.
  scaledPath(places) {
    const { path_std: deviation } = this.contract.scaling;
    return [0, 1, 2].flatMap((axis) => places.map((place, i) => place[axis] / deviation[axis][i]));
  }

  // A scaled body [channels, frames] along a scaled path, drawn from fainter noise than goals and paths are,
  // and no other.
  body(codes, path, { noise, steps, interactivity, company = [] }) {
    const denoise = (code) => (x, t) =>
      this.networks.body({
        x: [x, [1, this.channels, this.frames]],
        ...this.step(1, t, code),
        control: [path, [1, 3, this.frames]],
        keep: [Float32Array.of(1), [1, 1]],
      });
    const faint = noise.map((value) => value * this.contract.sampling.body_noise_std);
    return this.run(denoise, codes, faint, {
      method: 'dpm_solver',
      count: steps,
      interactivity: Math.min(interactivity, 1),
      company: company.map((scale) => Math.min(scale, 1)),
    });
  }

  step(count, t, code) {
    const condition = new Float32Array(count * code.length);
    for (let i = 0; i < count; i++) condition.set(code, i * code.length);
    return { t: [new Float32Array(count).fill(t), [count]], condition: [condition, [count, code.length]] };
  }

  // denoise: gives the denoiser of a code, by its number among the full one and the references of guidance.
  run(denoise, codes, noise, { interactivity, company = [], ...options }) {
    const denoisers = [codes.full, ...codes.references].map((code, number) => denoise(code, number));
    const weights = guidanceWeights([interactivity, ...company]);
    return sample(guided(denoisers, weights), noise, this.contract.schedule, options);
  }

  // Goals alone, in the world.
  async sampleGoals(question) {
    const { frame, ...observation } = this.senses.observe(
      question.past,
      question.observer,
      question.companions,
    );
    const codes = await this.codes(observation, question.keep, question.interactivity, question.company);
    return {
      goals: this.goalsInWorld(
        frame,
        await this.sampledGoals(codes, question.samples, this.drawing(frame, question)),
      ),
    };
  }

  // How a plan is drawn; `frame` is among it where the scene, which plans are kept to, is perceived. Plans that
  // are what the networks predict are kept neither to it nor away from bodies.
  drawing(frame, { seed, steps, interactivity, company, keep, observer, companions = [] }) {
    const { avoid_solid: kept } = this.contract.sampling;
    return {
      method: this.contract.sampling.method,
      draw: normals(seed),
      steps,
      interactivity,
      company,
      frame: keep.scene && kept ? frame : null,
      detour: keep.scene ? this.senses.detour : null,
      bodies: (kept ? [observer, ...companions] : []).map((places) => [places.at(-1)[0], places.at(-1)[2]]),
    };
  }

  // Scaled goals that it thinks of by itself.
  sampledGoals(codes, samples, options) {
    const steps = Math.max(options.steps, this.contract.sampling.goal_steps);
    return this.goals(codes, samples, { ...options, noise: options.draw(3 * samples), steps });
  }

  goalsInWorld(frame, scaled) {
    return Array.from({ length: scaled.length / 3 }, (_, i) => apply(frame, this.goal(scaled, i)));
  }

  // A whole plan. question: {past, observer, companions, keep, interactivity, company, samples, steps, seed, aim,
  // raised, path}, of which `company` holds the scales of guidance of the companions.
  // `cleared` is where a plan ends that goes all the way to the aim: as near to it as the animal may be, not
  // where somebody in its way holds it up.
  async plan(question) {
    const observation = this.senses.observe(question.past, question.observer, question.companions);
    const { frame } = observation;
    const options = this.drawing(frame, question);
    const codes = await this.codes(observation, question.keep, question.interactivity, question.company);
    if (question.path) return this.followed(frame, codes, question.path, options);
    const commanded = Boolean(question.aim);
    const leg = commanded && this.leg(frame, question.aim, question.raised, options.detour);
    // the goal that it keeps until the horizon
    const kept = !commanded && question.intent?.at(-1);
    const given = kept ? Float32Array.from(this.scaled(apply(inverse(frame), kept))) : leg.scaled;
    const scaled = given ?? (await this.sampledGoals(codes, question.samples, options));
    const keepGoal = commanded ? 1 : question.keep.goal;
    const goals = this.goalsInWorld(frame, scaled);
    const { avoid_solid: chosen } = this.contract.sampling; // else the first goal and path are taken
    const count = chosen ? CANDIDATES : 1;
    const tried = given ? Array(count).fill(0) : (chosen ? this.insideFirst(goals) : [0]).slice(0, count);
    const towards = async (numbers) => {
      const targets = Float32Array.from(
        numbers.flatMap((i) => Array.from(scaled.subarray(3 * i, 3 * i + 3))),
      );
      const paths = await this.paths(codes, targets, {
        ...options,
        keepGoal,
        commanded,
        draws: this.contract.sampling.max_path_draws,
        noise: options.draw(this.pathChannels * this.frames * numbers.length),
      });
      const each = numbers.map((_, i) => paths.subarray(3 * this.frames * i, 3 * this.frames * (i + 1)));
      if (commanded) for (const path of each) this.bendToGoal(path, scaled, question.raised);
      return each;
    };
    // as in Python, one path unless it leaves the room or has to be near what the animal intends
    const [first, rest] = question.intent ? [tried, []] : [tried.slice(0, 1), tried.slice(1)];
    const paths = await towards(first);
    if (rest.length && this.outside(frame, paths[0])) paths.push(...(await towards(rest)));
    const best = this.bestInside(frame, paths, question.intent ?? []);
    const places = this.positions(paths[best]);
    const path = this.constrained(frame, codes.start, places, options);
    const lived = await this.withBody(frame, codes, path, options);
    const end = lived.path.at(-1);
    const arrives =
      leg.last &&
      distance(end, this.endAlone(frame, codes.start, places, options)) < this.clearance + ARRIVED_M &&
      !options.detour?.unfinished(apply(frame, codes.start), end, question.aim);
    return { goals, chosen: tried[best], ...lived, cleared: arrives ? end : null };
  }

  // Where a path of places of the ego frame would end with nobody in its way, world.
  endAlone(frame, start, places, options) {
    const path = this.constrained(frame, start, places, { ...options, bodies: [] });
    return apply(frame, this.positions(path).at(-1));
  }

  // The numbers of goals, those that lie in the allowed space first, otherwise as sampled.
  insideFirst(goals) {
    const inside = goals.map((goal) => this.senses.space.allows(goal));
    return goals.map((_, i) => i).sort((a, b) => inside[b] - inside[a] || a - b);
  }

  // A visitor's goal binds: bend a scaled path so that it is there (on the floor plan) when a walk at the
  // animal's pace would be, and stays.
  bendToGoal(path, goal, raised) {
    const { path_std: deviation } = this.contract.scaling;
    const target = this.goal(goal);
    const arrival = Math.min(
      this.frames - 1,
      Math.max(SOONEST, Math.ceil((Math.hypot(target[0], target[2]) / this.pace) * this.contract.rate_hz)),
    );
    for (const axis of raised ? [0, 1, 2] : [0, 2]) {
      const missing = target[axis] - path[axis * this.frames + arrival] * deviation[axis][arrival];
      for (let i = 0; i < this.frames; i++) {
        const place =
          path[axis * this.frames + i] * deviation[axis][i] + missing * ((i + 1) / (arrival + 1)) ** 1.2;
        path[axis * this.frames + i] = (i < arrival ? place : target[axis]) / deviation[axis][i];
      }
    }
  }

  // A plan along places that the visitor has drawn, points of the world, one a frame.
  async followed(frame, codes, places, options) {
    const egoFromWorld = inverse(frame);
    const path = this.constrained(
      frame,
      codes.start,
      places.map((place) => apply(egoFromWorld, place)),
      options,
    );
    return { goals: [places.at(-1)], chosen: 0, ...(await this.withBody(frame, codes, path, options)) };
  }

  // Places of the ego frame as a scaled path that is possible: where the animal may be (unless it does not
  // perceive the scene), around furniture that was moved and the bodies of others, the person's last, on what
  // carries it.
  constrained(frame, start, places, { frame: perceived, detour, bodies }) {
    const egoFromWorld = inverse(frame);
    const [from, clear] = [
      apply(frame, start),
      (place) => (perceived ? this.senses.space.cleared(place) : place),
    ];
    const wanted = places.map((place) => apply(frame, place));
    const avoiding = bodies.reduceRight(
      (path, body) => aroundPerson(path, from, body, this.clearance, clear),
      (detour?.lead(wanted, from) ?? wanted).map(clear),
    );
    const around = detour?.halted(avoiding, from) ?? avoiding;
    const world = perceived
      ? this.senses.support.follow(
          around,
          from,
          this.contract.path_encoding.rest_speed_m_s / this.contract.rate_hz,
        )
      : around;
    return Float32Array.from(this.scaledPath(world.map((place) => apply(egoFromWorld, place))));
  }

  // The body along a scaled path, and both in the world.
  async withBody(frame, codes, path, options) {
    const body = await this.body(codes, path, {
      ...options,
      noise: options.draw(this.channels * this.frames),
    });
    const { positions, bodies } = this.unscaled(path, body);
    return {
      path: positions.map((position) => apply(frame, position)),
      frames: positions.map((position, i) => this.clampHeight(this.senses.rows(frame, position, bodies[i]))),
    };
  }

  // Of the paths that leave the allowed space least, the one nearest to the intended places, world, or the first.
  bestInside(frame, paths, intent) {
    const scores = paths.map((path, i) => {
      const places = this.positions(path).map((place) => apply(frame, place));
      const off = intent.reduce((sum, place, frames) => sum + distance(places[frames], place), 0);
      return { i, outside: this.outside(frame, path), off };
    });
    return scores.sort((a, b) => a.outside - b.outside || a.off - b.off || a.i - b.i)[0].i;
  }

  // How many places of a scaled path are outside of the allowed space.
  outside(frame, path) {
    return this.positions(path).filter((place) => !this.senses.space.allows(apply(frame, place))).length;
  }

  // Over many plans small errors of height add up: keep the root between the heights that recordings know.
  clampHeight(rows) {
    const [low, high] = this.heights;
    rows[1] = Math.min(high, Math.max(low, rows[1]));
    return rows;
  }

  // The visitor's goal in scaled units, not further than the animal goes in one plan, on the way around moved
  // furniture where that is in between; and whether it is there then.
  leg(frame, aim, raised, detour) {
    const egoFromWorld = inverse(frame);
    const scaled = (point) => {
      const [x, y, z] = apply(egoFromWorld, point);
      return this.scaled([x, raised ? y : 0, z]);
    };
    const share = (point) => Math.min(1, FURTHEST / Math.max(1e-6, Math.hypot(...scaled(point))));
    let target = aim;
    if (share(aim) < 1 && detour?.crosses(frame, aim)) {
      const way = detour.route(frame, aim);
      target = way[way.findIndex((point) => share(point) < 1) - 1] ?? way.at(-1) ?? aim;
    }
    const part = share(target);
    return {
      scaled: Float32Array.from(scaled(target), (value) => value * part),
      last: target === aim && part === 1,
    };
  }

  // Meters and channels, frame by frame.
  unscaled(path, body) {
    const { body_mean: mean, body_std: deviation } = this.contract.scaling;
    const each = Array.from({ length: this.frames }, (_, i) => i);
    return {
      positions: this.positions(path),
      bodies: each.map((i) =>
        mean.map((center, channel) => body[channel * this.frames + i] * deviation[channel] + center),
      ),
    };
  }

  positions(path) {
    const deviation = this.contract.scaling.path_std;
    return Array.from({ length: this.frames }, (_, i) =>
      [0, 1, 2].map((axis) => path[axis * this.frames + i] * deviation[axis][i]),
    );
  }

  // The fixed plan that Python wrote down, sampled again from the same input and noise.
  async golden(golden) {
    const { architecture, grid, past_frames: count } = this.contract;
    const wave = (length, amplitude, frequency) =>
      Float32Array.from({ length }, (_, i) => amplitude * Math.sin(frequency * i));
    const observation = {
      sceneGrid: wave(architecture.scene_channels * grid.shape.reduce((a, b) => a * b), 0.25, 0.01),
      past: wave(count * (9 + 6 * architecture.bones), 0.1, 0.1),
      others: Float32Array.from(golden.input.others.flat(Infinity)),
    };
    const [scene, observer, past] = golden.input.keep;
    const noise = (name) => Float32Array.from(golden.noise[name].flat());
    const plans = {};
    for (const name of Object.keys(golden.plans)) {
      const options = { method: golden.sampling.method, interactivity: Number(name.split('_')[1]) };
      const codes = await this.codes(observation, { scene, observer, past }, options.interactivity);
      const goal = await this.goals(codes, 1, {
        ...options,
        steps: golden.sampling.goal_steps,
        noise: noise('goal'),
      });
      const path = await this.paths(codes, goal, {
        ...options,
        steps: golden.sampling.sequence_steps,
        noise: noise('path'),
      });
      const body = await this.body(codes, path, {
        ...options,
        steps: golden.sampling.sequence_steps,
        noise: noise('body'),
      });
      const { positions, bodies } = this.unscaled(path, body);
      plans[name] = { goal: this.goal(goal), path: positions, body: bodies };
    }
    return plans;
  }
}
