// What has been shown since the last start, written down at 10 Hz, as a table or as an animated model.

import { animated } from './gltf.js';
import { ROW } from './rigid.js';

const RATE_HZ = 10;
const LONGEST_TICKS = 18000; // half an hour

export class Take {
  constructor() {
    this.rows = [];
  }

  // frame: root and bones as rows; observer: the phone's row; goal: where the animal wants to be, or null.
  add(frame, observer, goal) {
    this.rows.push({
      frame: Float32Array.from(frame),
      observer: [...observer],
      goal: goal ? [...goal] : null,
    });
    if (this.rows.length > LONGEST_TICKS) this.rows.shift();
  }

  get seconds() {
    return Math.max(0, this.rows.length - 1) / RATE_HZ;
  }

  // One line per tick; meters, seconds, world frame, quaternion wxyz. The columns that `stages.simulate`
  // writes, then the goal.
  csv() {
    const head = [
      'time_s',
      'x',
      'y',
      'z',
      'qw',
      'qx',
      'qy',
      'qz',
      'speed_m_s',
      'observer_x',
      'observer_y',
      'observer_z',
      'distance_m',
      'goal_x',
      'goal_y',
      'goal_z',
    ];
    const lines = this.rows.map(({ frame, observer, goal }, i) => {
      const [before, after] = [
        this.rows[Math.max(0, i - 1)].frame,
        this.rows[Math.min(this.rows.length - 1, i + 1)].frame,
      ];
      const ticks = Math.min(this.rows.length - 1, i + 1) - Math.max(0, i - 1) || 1;
      const speed =
        (Math.hypot(after[0] - before[0], after[1] - before[1], after[2] - before[2]) * RATE_HZ) / ticks;
      const distance = Math.hypot(observer[0] - frame[0], observer[2] - frame[2]);
      const numbers = [i / RATE_HZ, ...frame.subarray(0, ROW), speed, ...observer.slice(0, 3), distance];
      return [
        ...numbers.map((value) => value.toFixed(5)),
        ...(goal ? goal.map((value) => value.toFixed(5)) : ['', '', '']),
      ].join(',');
    });
    return new Blob([[head.join(','), ...lines, ''].join('\n')], { type: 'text/csv' });
  }

  // model: the animal's GLB without animation.
  glb(model) {
    const times = Float32Array.from(this.rows, (_, i) => i / RATE_HZ);
    return new Blob(
      [
        animated(
          model,
          'take',
          times,
          this.rows.map((row) => row.frame),
        ),
      ],
      { type: 'model/gltf-binary' },
    );
  }
}

// A name as part of a file's name: letters and digits of any script.
export const fileStem = (name) => name.replace(/[^\p{L}\p{M}\p{N}_-]+/gu, '_');

export function save(blob, name) {
  const link = Object.assign(document.createElement('a'), {
    href: URL.createObjectURL(blob),
    download: name,
  });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
