// Recorded sessions at 10 Hz: where a simulation may begin, what a real animal did, where the person stood.
// And takes of `stages.simulate` that the visitor has opened.

import { ROW, lookAt, turnFromMatrix } from './rigid.js';
import { uniforms } from './noise.js';

const RATE_HZ = 10;

export class Clips {
  constructor(contract, values) {
    this.list = contract.clips; // [{name, start, count}], frames
    this.width = (contract.agent.bones.length + 2) * ROW; // root, bones, camera
    this.values = values;
    this.recorded = this.list.length;
    this.observer = contract.observer;
    this.floor = contract.scene.floor_m;
  }

  row(index) {
    return this.values.subarray(index * this.width, (index + 1) * this.width);
  }

  // Root and bones of a tick of a clip, repeated without end.
  frame(clip, tick) {
    return this.row(clip.start + (tick % clip.count)).subarray(0, this.width - ROW);
  }

  camera(clip, tick) {
    return this.row(clip.start + (tick % clip.count)).subarray(this.width - ROW);
  }

  // Append a take (arrays of its `take.npz`), every tenth of a second of it. Throws where it is not this
  // animal's.
  add(name, { timestamp_s: time, world_from_agent: root, agent_from_bone: bone, observer_world: seen }) {
    const bones = this.width / ROW - 2;
    if (!time || !root || !bone) throw new Error('it lacks timestamp_s, world_from_agent or agent_from_bone');
    if (bone.shape[1] !== bones) throw new Error(`it has ${bone.shape[1]} bones, this animal has ${bones}`);
    const count = Math.floor((time.values.at(-1) - time.values[0]) * RATE_HZ + 1.001);
    const values = new Float32Array(this.values.length + count * this.width);
    values.set(this.values);
    const [x, z] = this.observer.start_m;
    for (let tick = 0, frame = 0; tick < count; tick++) {
      while (
        frame + 1 < time.values.length &&
        time.values[frame + 1] - time.values[0] < tick / RATE_HZ + 1e-3
      )
        frame++;
      const place = row(root.values, frame);
      const eye = seen
        ? Array.from(seen.values.subarray(3 * frame, 3 * frame + 3))
        : [x, this.floor + this.observer.eye_height_m, z];
      const rows = [
        place,
        ...Array.from({ length: bones }, (_, k) => row(bone.values, frame * bones + k)),
        lookAt(eye, place.slice(0, 3)),
      ];
      values.set(rows.flat(), this.values.length + tick * this.width);
    }
    let unique = name;
    for (let number = 2; this.list.some((clip) => clip.name === unique); number++)
      unique = `${name} ${number}`;
    const clip = { name: unique, start: this.values.length / this.width, count, opened: true };
    this.values = values;
    this.list.push(clip);
    return clip;
  }

  each(visit) {
    for (const clip of this.list)
      for (let tick = 0; tick < clip.count; tick++) visit(this.frame(clip, tick), this.camera(clip, tick));
  }

  // The first `count` frames of a clip.
  beginning(clip, count) {
    const frames = Array.from({ length: count }, (_, i) => this.frame(clip, Math.min(clip.count - 1, i)));
    const last = Math.min(clip.count, count) - 1;
    return { frames, observer: this.camera(clip, last), clip, last };
  }

  // A recorded past of `count` frames; the same seed gives the same moment.
  moment(seed, count) {
    const draw = uniforms(seed + 1);
    const clip = this.list[Math.floor(draw() * this.recorded)];
    const last = count - 1 + Math.floor(draw() * Math.max(1, clip.count - count));
    const frames = Array.from({ length: count }, (_, i) =>
      this.frame(clip, Math.max(0, last - count + 1 + i)),
    );
    return { frames, observer: this.camera(clip, last), clip, last };
  }

  // The past of `count` frames in the session and at the time of another animal's moment; one of its own
  // where this animal was not seen then.
  beside({ clip: theirs, last: tick }, seed, count) {
    const clip = this.list.find(({ name, opened }) => name === theirs.name && !opened);
    const last = clip && Math.round((theirs.begin_s - clip.begin_s) * RATE_HZ) + tick;
    if (!clip || theirs.opened || last < count - 1 || last >= clip.count) return this.moment(seed, count);
    const frames = Array.from({ length: count }, (_, i) => this.frame(clip, last - count + 1 + i));
    return { frames, observer: this.camera(clip, last), clip, last };
  }
}

// The rigid motion of one 4 by 4 matrix of many, row by row.
function row(values, index) {
  const m = values.subarray(16 * index, 16 * index + 16);
  return [m[3], m[7], m[11], ...turnFromMatrix([m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]])];
}
