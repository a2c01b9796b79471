// Recorded sessions at 10 Hz: where a simulation may begin, what a real animal did, where the person stood.

import { ROW } from './rigid.js';
import { uniforms } from './noise.js';

export class Clips {
  constructor(contract, values) {
    this.list = contract.clips; // [{name, start, count}], frames
    this.width = (contract.agent.bones.length + 2) * ROW; // root, bones, camera
    this.values = values;
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

  each(visit) {
    for (const clip of this.list) for (let tick = 0; tick < clip.count; tick++) visit(this.frame(clip, tick), this.camera(clip, tick));
  }

  // The first `count` frames of a clip.
  beginning(clip, count) {
    const frames = Array.from({ length: count }, (_, i) => this.frame(clip, Math.min(clip.count - 1, i)));
    return { frames, observer: this.camera(clip, Math.min(clip.count, count) - 1) };
  }

  // A recorded past of `count` frames; the same seed gives the same moment.
  moment(seed, count) {
    const draw = uniforms(seed + 1);
    const clip = this.list[Math.floor(draw() * this.list.length)];
    const last = count - 1 + Math.floor(draw() * Math.max(1, clip.count - count));
    const frames = Array.from({ length: count }, (_, i) => this.frame(clip, Math.max(0, last - count + 1 + i)));
    return { frames, observer: this.camera(clip, last) };
  }
}
