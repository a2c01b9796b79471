// Draw as many pixels as the machine manages: fewer when frames come slowly, more again when they come
// easily.

const HURRY_FRAMES = 12;

export class Steadiness {
  // most, least: drawn pixels per pixel of the screen; wanted: milliseconds between frames.
  constructor(most, least, wanted, apply) {
    Object.assign(this, { most, least, wanted, apply, ratio: most, sum: 0, count: 0 });
  }

  note(milliseconds) {
    this.sum += Math.min(500, milliseconds);
    if (++this.count < HURRY_FRAMES) return;
    const mean = this.sum / this.count;
    this.sum = this.count = 0;
    const share =
      mean > 1.15 * this.wanted
        ? Math.max(0.7, Math.sqrt(this.wanted / mean))
        : mean < 0.7 * this.wanted
          ? 1.12
          : 1;
    const ratio = Math.min(this.most, Math.max(this.least, this.ratio * share));
    if (Math.abs(ratio - this.ratio) < 0.02) return;
    this.ratio = ratio;
    this.apply(ratio);
  }
}
