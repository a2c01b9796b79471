// Furniture of a home: what stands on its floor apart from the walls, where it may be set down, and what a
// volume is like after some of it has been moved. Volumes are those of simulator.json; cells are numbers of
// voxels; `by` is a move over the floor, in voxels along x and z.

const [FREE, SOLID, UNSEEN] = [0, 1, 2]; // of an occupancy
const [SUPPORTED, FILLED] = [2, 3]; // marks of allowed voxels, as in pipeline/behavior/support.py
const FLOOR_SHARE = 0.25; // as there
const TALL_M = 1.7; // what rises higher above the floor is a wall, or built in
const LONGEST_M = 3; // of what a person moves
const FEWEST_CELLS = 6; // less is an error of the map
const REACH_CELLS = 2; // around a click, in which furniture is looked for
const LOWEST_M = 0.03; // above the floor: what is lower is drawn as floor
const BESIDE = [
  [1, 0, 0],
  [-1, 0, 0],
  [0, 0, 1],
  [0, 0, -1],
  [0, 1, 0],
  [0, -1, 0],
];

// The voxels of a volume by number, by place in the grid [a, b, c] and by meters of the world.
export class Grid {
  constructor({ shape: [, vx, vy, vz], origin, voxel_m: voxel }) {
    Object.assign(this, { vx, vy, vz, origin, voxel, count: vx * vy * vz });
  }

  number(a, b, c) {
    const inside = a >= 0 && b >= 0 && c >= 0 && a < this.vx && b < this.vy && c < this.vz;
    return inside ? (a * this.vy + b) * this.vz + c : -1;
  }

  place(cell) {
    return [Math.floor(cell / (this.vy * this.vz)), Math.floor(cell / this.vz) % this.vy, cell % this.vz];
  }

  at(point) {
    return this.number(...point.map((value, axis) => Math.floor((value - this.origin[axis]) / this.voxel)));
  }

  center(cell) {
    return this.place(cell).map((index, axis) => this.origin[axis] + (index + 0.5) * this.voxel);
  }

  // The number of the column of a cell, and of the one at [x, z]; -1 outside.
  column(cell) {
    return Math.floor(cell / (this.vy * this.vz)) * this.vz + (cell % this.vz);
  }

  columnAt(x, z) {
    const [a, c] = [
      Math.floor((x - this.origin[0]) / this.voxel),
      Math.floor((z - this.origin[2]) / this.voxel),
    ];
    return a >= 0 && c >= 0 && a < this.vx && c < this.vz ? a * this.vz + c : -1;
  }

  columnCenter(column) {
    const [a, c] = [Math.floor(column / this.vz), column % this.vz];
    return [this.origin[0] + (a + 0.5) * this.voxel, this.origin[2] + (c + 0.5) * this.voxel];
  }

  // The cell a move away, or -1.
  moved(cell, [da, dc]) {
    const [a, b, c] = this.place(cell);
    return this.number(a + da, b, c + dc);
  }

  movedColumn(column, [da, dc]) {
    const [a, c] = [Math.floor(column / this.vz) + da, (column % this.vz) + dc];
    return a >= 0 && c >= 0 && a < this.vx && c < this.vz ? a * this.vz + c : -1;
  }

  // The layer of voxels right above the floor, as marks or else its height say.
  floorLayer(allowed, floor) {
    const carried = Array(this.vy).fill(0);
    for (let cell = 0; cell < this.count; cell++)
      if (allowed[cell] === SUPPORTED) carried[this.place(cell)[1]] += 1;
    const most = Math.max(...carried);
    if (most > 0) return carried.findIndex((count) => count >= FLOOR_SHARE * most);
    return Math.floor((floor - this.origin[1]) / this.voxel) + 1;
  }
}

export class Furniture {
  constructor(volume, occupancy, allowed, floor) {
    const grid = new Grid(volume);
    Object.assign(this, { grid, occupancy, allowed, floor, level: grid.floorLayer(allowed, floor) });
    this.tall = Math.round(TALL_M / grid.voxel);
    this.walls = this.wallColumns();
    this.owner = new Int32Array(grid.count);
    this.pieces = [];
    for (const cells of this.components()) this.add(cells);
    this.addRims();
    for (const piece of this.pieces) this.measure(piece);
  }

  // One for each column in which something solid is as high as walls are.
  wallColumns() {
    const { grid, level, tall } = this;
    const walls = new Uint8Array(grid.vx * grid.vz);
    for (let a = 0; a < grid.vx; a++)
      for (let c = 0; c < grid.vz; c++)
        for (let b = level + tall; b < level + tall + 2; b++)
          if (this.occupancy[grid.number(a, b, c)] === SOLID) walls[a * grid.vz + c] = 1;
    return walls;
  }

  // Whether a column is a wall or, within one voxel, leans on one.
  leans(column) {
    for (const da of [-1, 0, 1])
      for (const dc of [-1, 0, 1]) if (this.walls[this.grid.movedColumn(column, [da, dc])]) return true;
    return false;
  }

  loose(cell) {
    if (this.occupancy[cell] !== SOLID) return false;
    const b = this.grid.place(cell)[1];
    return b >= this.level && b < this.level + this.tall;
  }

  // What hangs together of the solid voxels above the floor that are apart from the walls.
  *components() {
    const { grid } = this;
    const open = new Uint8Array(grid.count);
    for (let cell = 0; cell < grid.count; cell++)
      open[cell] = this.loose(cell) && !this.leans(grid.column(cell)) ? 1 : 0;
    for (let first = 0; first < grid.count; first++) {
      if (!open[first]) continue;
      const found = [first];
      open[first] = 0;
      for (let i = 0; i < found.length; i++)
        for (const next of this.beside(found[i]))
          if (open[next]) {
            open[next] = 0;
            found.push(next);
          }
      yield found;
    }
  }

  beside(cell) {
    const [a, b, c] = this.grid.place(cell);
    return BESIDE.map(([da, db, dc]) => this.grid.number(a + da, b + db, c + dc)).filter((next) => next >= 0);
  }

  add(cells) {
    const layers = new Set(cells.map((cell) => this.grid.place(cell)[1]));
    if (cells.length < FEWEST_CELLS || layers.size < 2 || Math.min(...layers) > this.level + 1) return;
    this.pieces.push({ number: this.pieces.length + 1, cells, top: Math.max(...layers) });
    for (const cell of cells) this.owner[cell] = this.pieces.length;
  }

  // The last voxel before a wall belongs to the piece that touches it, as high as the piece is.
  addRims() {
    for (const piece of this.pieces)
      for (const cell of [...piece.cells])
        for (const next of this.beside(cell)) {
          const rim = this.loose(next) && !this.owner[next] && !this.walls[this.grid.column(next)];
          if (!rim || this.grid.place(next)[1] > piece.top) continue;
          piece.cells.push(next);
          this.owner[next] = piece.number;
        }
  }

  // Columns of a piece, its extent, and its cells with what nobody saw beneath them, which moves along.
  measure(piece) {
    const { grid } = this;
    const highest = new Map();
    for (const cell of piece.cells) {
      const [column, b] = [grid.column(cell), grid.place(cell)[1]];
      highest.set(column, Math.max(b, highest.get(column) ?? 0));
    }
    const hidden = [];
    for (const [column, top] of highest)
      for (let b = this.level; b < top; b++) {
        const cell = grid.number(Math.floor(column / grid.vz), b, column % grid.vz);
        if (this.occupancy[cell] === UNSEEN) hidden.push(cell);
      }
    piece.columns = [...highest.keys()];
    piece.footprint = new Set(piece.columns);
    piece.all = [...piece.cells, ...hidden];
    [piece.seed] = piece.cells;
    const extent = (places) => (Math.max(...places) - Math.min(...places) + 1) * grid.voxel;
    const places = piece.columns.map((column) =>
      grid.columnCenter(column).map((value) => value / grid.voxel),
    );
    piece.span_m = Math.max(extent(places.map(([x]) => x)), extent(places.map(([, z]) => z)));
  }

  // The piece at a point of the unmoved home, or why there is none to move: {piece} or {reason}.
  find(point) {
    const { grid } = this;
    const [a, b, c] = grid.place(Math.max(0, grid.at(point)));
    let [nearest, far, solid] = [0, Infinity, false];
    const range = Array.from({ length: 2 * REACH_CELLS + 1 }, (_, i) => i - REACH_CELLS);
    for (const da of range)
      for (const db of range)
        for (const dc of range) {
          const cell = grid.number(a + da, b + db, c + dc);
          const distance = da * da + db * db + dc * dc;
          if (cell < 0 || !this.loose(cell) || distance >= far) continue;
          [nearest, far, solid] = [this.owner[cell], distance, true];
        }
    if (!nearest)
      return {
        reason: solid
          ? 'This is a wall, built in or hanging: it cannot be moved.'
          : 'Nothing stands here: press on a piece of furniture.',
      };
    const piece = this.pieces[nearest - 1];
    if (!this.isMovable(piece)) return { reason: `This is too large to move: ${piece.span_m.toFixed(1)} m.` };
    return { piece };
  }

  isMovable(piece) {
    return piece.span_m <= LONGEST_M;
  }

  // The number of the piece that a point of the room's surface, unmoved, is part of, or 0.
  pieceAt(point) {
    if (point[1] < this.floor + LOWEST_M) return 0;
    const cell = this.grid.at(point);
    if (cell < 0) return 0;
    if (this.owner[cell] || this.occupancy[cell] === SOLID) return this.owner[cell];
    const [a, b, c] = this.grid.place(cell);
    for (const da of [0, -1, 1])
      for (const db of [0, -1, 1])
        for (const dc of [0, -1, 1]) {
          const number = this.owner[this.grid.number(a + da, b + db, c + dc)];
          if (number) return number;
        }
    return 0;
  }

  // Why a piece cannot be set down at a move from where it was recorded, or null. others: the moves of other
  // pieces; bodies: [{name, place: [x, z]}] that are in the way within `apart`, meters.
  refusal(piece, by, others, bodies, apart) {
    const { grid, level } = this;
    const { occupancy } = arranged(this, [...others, { cells: piece.all, by: null }]);
    for (const cell of piece.cells) {
      const there = grid.moved(cell, by);
      // a rug is no obstacle
      const rug = grid.place(there)[1] === level && occupancy[there + grid.vz] !== SOLID;
      if (occupancy[there] === SOLID && !rug) return 'Something else stands there.';
    }
    const vacated = new Set([piece, ...others.map((other) => other.piece)].flatMap(({ columns }) => columns));
    for (const column of piece.columns) {
      const there = grid.movedColumn(column, by);
      if (there < 0 || !(vacated.has(there) || this.hasFloor(there))) return 'There is no floor to stand on.';
      const [x, z] = grid.columnCenter(there);
      const body = bodies.find(({ place }) => Math.hypot(place[0] - x, place[1] - z) < apart);
      if (body) return `${body.name} in the way.`;
    }
    return null;
  }

  // The columns of a piece and those beside it, without walls.
  around({ columns }) {
    const grown = new Set(columns);
    for (const column of columns)
      for (const da of [-1, 0, 1])
        for (const dc of [-1, 0, 1]) grown.add(this.grid.movedColumn(column, [da, dc]));
    return [...grown].filter((column) => column >= 0 && !this.walls[column]);
  }

  hasFloor(column) {
    const [a, c] = [Math.floor(column / this.grid.vz), column % this.grid.vz];
    for (let b = this.level - 1; b <= this.level + 1; b++)
      if (this.allowed[this.grid.number(a, b, c)] >= SUPPORTED) return true;
    return false;
  }
}

// Occupancy and marks of where the root may be, {occupancy, allowed}, after some moves [{cells, by}, ...];
// with `by` null cells are taken away. home: {grid, occupancy, allowed, level}, which stays as it is.
export function arranged(home, moves) {
  const { grid, level } = home;
  if (!moves.length) return { occupancy: home.occupancy, allowed: home.allowed };
  const occupancy = home.occupancy.slice();
  // where the animal has been although it is not free goes with what it was on
  const visited = home.allowed.map((mark, cell) => (mark && occupancy[cell] !== FREE ? 1 : 0));
  const [from, columns] = [visited.slice(), new Set()];
  for (const { cells } of moves)
    for (const cell of cells) {
      occupancy[cell] = FREE;
      visited[cell] = 0;
      columns.add(grid.column(cell));
    }
  const vacated = new Set(columns);
  for (const { cells, by } of moves.filter((move) => move.by))
    for (const cell of cells) {
      const there = grid.moved(cell, by);
      if (there < 0 || occupancy[there] === SOLID) continue;
      occupancy[there] = home.occupancy[cell];
      visited[there] = from[cell];
      columns.add(grid.column(there));
    }
  const allowed = home.allowed.slice();
  for (const column of columns) mark(grid, column, { occupancy, visited, allowed });
  for (const column of vacated) fill(grid, column, level, { occupancy, allowed });
  return { occupancy, allowed };
}

// Mark a column as pipeline/behavior/support.py does; floor that was filled stays filled.
function mark({ vy, vz }, column, { occupancy, visited, allowed }) {
  const first = Math.floor(column / vz) * vy * vz + (column % vz);
  for (let b = 0, cell = first; b < vy; b++, cell += vz) {
    const open = occupancy[cell] === FREE || visited[cell];
    const above = b > 0 && occupancy[cell - vz] === SOLID && occupancy[cell] !== SOLID;
    if (!open) allowed[cell] = 0;
    else if (above) allowed[cell] = SUPPORTED;
    else if (allowed[cell] !== FILLED) allowed[cell] = 1;
  }
}

// Where furniture stood that hid the floor, the floor goes on.
function fill({ vy, vz }, column, level, { occupancy, allowed }) {
  const first = Math.floor(column / vz) * vy * vz + (column % vz);
  const marks = [level - 1, level, level + 1].map((b) => allowed[first + b * vz]);
  const floor = first + level * vz;
  if (occupancy[floor] === FREE && !marks.some((value) => value >= SUPPORTED)) allowed[floor] = FILLED;
}

// Features after the moves: those of free space, zero, where furniture stood. values: channel first.
export function movedFeatures(values, grid, moves) {
  const out = values.slice();
  for (let first = 0; first < values.length; first += grid.count) {
    for (const { cells } of moves) for (const cell of cells) out[first + cell] = 0;
    for (const { cells, by } of moves)
      for (const cell of cells) {
        const there = grid.moved(cell, by);
        if (there >= 0) out[first + there] = values[first + cell];
      }
  }
  return out;
}

// Cells of one grid that lie in cells of another.
export function sameCells(cells, from, to) {
  const wanted = new Set(cells.map((cell) => to.at(from.center(cell))));
  wanted.delete(-1);
  return [...wanted];
}
