// A drawn path: smoothed points on the floor, and where a walker that follows it is at each tick.

const SPACING_M = 0.05;
const TICK_S = 0.1;
const ACCELERATION_M_S2 = 1.5; // how quickly the walker gains speed
const AHEAD_M = 0.8; // how far beyond what is done the walker may be found
export const ARRIVED_M = 0.12;

export class Route {
  // places: [[x, z], ...] in meters, in the order drawn.
  constructor(places) {
    this.points = evenly(places);
    this.length = SPACING_M * (this.points.length - 1);
    this.done = 0;
  }

  get finished() {
    return this.done >= this.length - ARRIVED_M;
  }

  at(along) {
    const place = Math.min(this.points.length - 1, Math.max(0, along / SPACING_M));
    const index = Math.min(this.points.length - 2, Math.floor(place));
    const share = place - index;
    return [0, 1].map(
      (axis) => this.points[index][axis] * (1 - share) + this.points[index + 1][axis] * share,
    );
  }

  // Note how far the walker at [x, z] has come; it never goes back.
  advance(here) {
    let nearest = Infinity;
    const from = this.done;
    for (let along = from; along <= Math.min(this.length, from + AHEAD_M); along += SPACING_M / 2) {
      const [x, z] = this.at(along);
      const distance = Math.hypot(x - here[0], z - here[1]);
      if (distance < nearest - 1e-9) [nearest, this.done] = [distance, along];
    }
    if (Math.hypot(...this.at(this.length).map((value, axis) => value - here[axis])) < ARRIVED_M)
      this.done = Math.max(this.done, Math.min(this.length, this.done + AHEAD_M));
  }

  // Places at the next ticks for a walker at root [x, y, z] with a speed now (m/s) and a pace to reach;
  // what it stands beside the route fades within the first second, and so does its height above `standing`.
  ahead(root, speed, pace, standing, count) {
    const start = this.at(this.done);
    let along = this.done;
    return Array.from({ length: count }, (_, i) => {
      speed = Math.min(pace, speed + ACCELERATION_M_S2 * TICK_S);
      along = Math.min(this.length, along + speed * TICK_S);
      const beside = Math.max(0, 1 - (i + 1) / 10) ** 2;
      const [x, z] = this.at(along);
      return [
        x + beside * (root[0] - start[0]),
        standing + beside * (root[1] - standing),
        z + beside * (root[2] - start[1]),
      ];
    });
  }

  // Some of its points, enough to draw it again.
  get corners() {
    return this.points.filter((_, i) => i % 4 === 0 || i === this.points.length - 1);
  }
}

// Points every 5 cm along the line, corners rounded.
function evenly(places) {
  const dense = [places[0]];
  for (const place of places.slice(1)) {
    let last = dense.at(-1);
    let distance = Math.hypot(place[0] - last[0], place[1] - last[1]);
    while (distance >= SPACING_M) {
      const share = SPACING_M / distance;
      last = last.map((value, axis) => value + share * (place[axis] - value));
      dense.push(last);
      distance = Math.hypot(place[0] - last[0], place[1] - last[1]);
    }
  }
  if (dense.length < 2) dense.push([dense[0][0] + SPACING_M, dense[0][1]]);
  const reach = 3;
  return dense.map((point, i) => {
    const around = Math.min(reach, i, dense.length - 1 - i);
    const near = dense.slice(i - around, i + around + 1);
    return [0, 1].map((axis) => near.reduce((sum, other) => sum + other[axis], 0) / near.length);
  });
}
