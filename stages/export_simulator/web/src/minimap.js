// The room from above, turned as the view of the whole room is: a faint picture, where animal and observer
// have been, where they are and what comes next.

const CELLS = 72;
const COLORS = { animal: [200, 114, 43], observer: [47, 111, 159] };

export class Minimap {
  // heading: what is up on the map, radians from +z towards +x.
  constructor(canvas, picture, heading) {
    this.pen = canvas.getContext('2d');
    this.center = picture.center;
    this.ahead = [Math.sin(heading), Math.cos(heading)];
    this.turn = heading + Math.PI;
    this.size = canvas.width;
    this.half = 1.06 * this.reach(picture);
    this.paint(picture);
    this.heat = { animal: new Float32Array(CELLS * CELLS), observer: new Float32Array(CELLS * CELLS) };
    this.layers = { animal: heatLayer(), observer: heatLayer() };
    this.stale = true;
  }

  // Show another picture of the same room.
  paint(picture) {
    this.back = backdrop(picture, this.size, picture.half / this.half, this.turn);
  }

  // How far to the right and down on the map something is that lies x, z beside the center.
  turned(x, z) {
    const [fx, fz] = this.ahead;
    return [x * -fz + z * fx, -(x * fx + z * fz)];
  }

  // World x, z to map pixels.
  pixel(x, z) {
    const scale = this.size / (2 * this.half);
    return this.turned(x - this.center[0], z - this.center[1]).map((value) => value * scale + this.size / 2);
  }

  // How far the room goes on the turned map, meters from its middle.
  reach({ pixels, half }) {
    const side = Math.sqrt(pixels.length / 4);
    let furthest = 0;
    for (let i = 0; i < side * side; i++) {
      if (isPaper(pixels, i)) continue;
      const [x, z] = [i % side, side - 1 - Math.floor(i / side)].map(
        (place) => ((place + 0.5) / side - 0.5) * 2 * half,
      );
      furthest = Math.max(furthest, ...this.turned(x, z).map(Math.abs));
    }
    return furthest || half;
  }

  visit(who, x, z, weight = 1) {
    const [px, py] = this.pixel(x, z);
    const [cx, cy] = [(px / this.size) * CELLS, (py / this.size) * CELLS];
    for (let j = Math.floor(cy - 2); j <= cy + 2; j++) {
      for (let i = Math.floor(cx - 2); i <= cx + 2; i++) {
        if (i < 0 || j < 0 || i >= CELLS || j >= CELLS) continue;
        const distance = (i + 0.5 - cx) ** 2 + (j + 0.5 - cy) ** 2;
        this.heat[who][j * CELLS + i] += weight * Math.exp(-distance / 1.4);
      }
    }
    this.stale = true;
  }

  draw({ animals, observer, goals, chosen, path, recorded, commands }) {
    const { pen, size } = this;
    if (this.stale)
      for (const who of ['observer', 'animal']) paintHeat(this.layers[who], this.heat[who], COLORS[who]);
    this.stale = false;
    pen.clearRect(0, 0, size, size);
    pen.globalAlpha = 0.55;
    pen.drawImage(this.back, 0, 0);
    pen.globalAlpha = 1;
    pen.imageSmoothingEnabled = true;
    for (const who of ['observer', 'animal']) pen.drawImage(this.layers[who], 0, 0, size, size);
    if (path) this.line(path);
    for (const [i, goal] of (goals ?? []).entries())
      this.dot(goal[0], goal[2], i === chosen ? 5 : 3, i === chosen ? 1 : 0.45);
    for (const wish of commands) this.cross(wish);
    if (recorded) this.dot(recorded[0], recorded[2], 7, 0.9, '#6d675e');
    for (const animal of animals) this.wedge(animal, `#${animal.color.toString(16)}`, false);
    this.wedge(observer, '#2f6f9f', true);
  }

  line(path) {
    const { pen } = this;
    pen.strokeStyle = '#4c8067';
    pen.lineWidth = 3;
    pen.lineCap = 'round';
    pen.beginPath();
    path.forEach((point, i) => pen[i ? 'lineTo' : 'moveTo'](...this.pixel(point[0], point[2])));
    pen.stroke();
  }

  dot(x, z, radius, alpha, color = '#c8722b') {
    const { pen } = this;
    pen.globalAlpha = alpha;
    pen.fillStyle = color;
    pen.beginPath();
    pen.arc(...this.pixel(x, z), radius, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
  }

  cross([x, z]) {
    const { pen } = this;
    const [px, py] = this.pixel(x, z);
    pen.beginPath();
    for (const side of [-1, 1]) {
      pen.moveTo(px - 6, py - 6 * side);
      pen.lineTo(px + 6, py + 6 * side);
    }
    // the rim is seen on a dark page
    for (const [color, width] of [
      ['#fff', 5],
      ['#2d2b28', 2.5],
    ]) {
      Object.assign(pen, { strokeStyle: color, lineWidth: width });
      pen.stroke();
    }
  }

  // A round body with a nose for the animal, a triangle for the person; both point where they look.
  wedge({ x, z, heading }, color, triangle) {
    const { pen } = this;
    const [px, py] = this.pixel(x, z);
    pen.save();
    pen.translate(px, py);
    pen.rotate(this.turn + Math.PI - heading);
    pen.fillStyle = color;
    pen.strokeStyle = '#fff';
    pen.lineWidth = 2.5;
    pen.beginPath();
    if (triangle) {
      pen.moveTo(0, -13);
      pen.lineTo(9, 10);
      pen.lineTo(-9, 10);
      pen.closePath();
    } else {
      pen.arc(0, 0, 8, 0, 7);
      pen.moveTo(-5, -6);
      pen.lineTo(0, -15);
      pen.lineTo(5, -6);
    }
    pen.stroke();
    pen.fill();
    pen.restore();
  }
}

const isPaper = (pixels, i) => pixels[4 * i + 3] === 0;

function backdrop({ pixels }, size, share, turn) {
  const side = Math.sqrt(pixels.length / 4);
  const raw = document.createElement('canvas');
  raw.width = raw.height = side;
  const image = new ImageData(side, side);
  for (let row = 0; row < side; row++)
    image.data.set(pixels.subarray((side - 1 - row) * side * 4, (side - row) * side * 4), row * side * 4);
  for (let i = 0; i < side * side; i++) if (isPaper(image.data, i)) image.data[4 * i + 3] = 0;
  raw.getContext('2d').putImageData(image, 0, 0);
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = size;
  const pen = canvas.getContext('2d');
  pen.filter = 'saturate(.45)';
  pen.translate(size / 2, size / 2);
  pen.rotate(turn);
  pen.drawImage(raw, (-size * share) / 2, (-size * share) / 2, size * share, size * share);
  return canvas;
}

function heatLayer() {
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = CELLS;
  return canvas;
}

function paintHeat(canvas, heat, [red, green, blue]) {
  const top = Math.max(1e-6, ...heat);
  const image = new ImageData(CELLS, CELLS);
  heat.forEach((value, i) => image.data.set([red, green, blue, 175 * Math.sqrt(value / top)], 4 * i));
  canvas.getContext('2d').putImageData(image, 0, 0);
}
