// The visitor's hands on furniture: pick up, carry, set down, undo. All animals of the home plan with what was
// moved, and the address keeps it.

import { Detour } from './detour.js';
import { Furniture, Grid, arranged, sameCells } from './furniture.js';
import { Movables } from './movables.js';
import * as panel from './panel.js';
import { meters } from './stops.js';
import { Support } from './support.js';

const APART_M = 0.25; // from the middle of whoever is there
const PERSON_M = 0.15; // kept from moved furniture
const BEGINNINGS = 50; // moments tried for one at which nothing stands on the animal

export class Mover {
  // home: the simulator, with {room, observer, residents, planner, ...}.
  constructor(home) {
    const [{ contract, occupancy, allowed }] = home.residents;
    const { floor_m: floor } = home.contract.scene;
    this.furniture = new Furniture(contract.volume, occupancy, allowed, floor);
    this.view = new Movables(home.room, this.furniture);
    this.homes = home.residents.map((resident) => {
      const grid = new Grid(resident.contract.volume);
      const level = grid.floorLayer(resident.allowed, floor);
      return { resident, grid, level, occupancy: resident.occupancy, allowed: resident.allowed };
    });
    Object.assign(this, { home, by: new Map(), past: [], held: null });
    home.observer.stands = (place) => this.stands(place);
  }

  // What controls do with furniture.
  get hands() {
    return {
      pick: (surface) => this.pick(surface),
      refuse: (reason) => this.say(reason),
      drag: (point) => this.drag(point),
      release: (set) => (set ? this.drop() : this.cancel()),
      carries: () => Boolean(this.held),
      nudge: (way) => this.nudge(this.seen(way)),
      take: () =>
        this.held && String(this.held.by) !== String(this.held.from) ? this.drop() : this.pickNext(),
      undo: () => this.undo(),
    };
  }

  // A step to the right and ahead in the view, along x or z: [voxels along x, along z].
  seen([right, ahead]) {
    const heading = this.home.room.heading();
    const dx = ahead * Math.sin(heading) - right * Math.cos(heading);
    const dz = ahead * Math.cos(heading) + right * Math.sin(heading);
    return Math.abs(dx) > Math.abs(dz) ? [Math.sign(dx), 0] : [0, Math.sign(dz)];
  }

  // What has been moved: [{piece, cells, by}, ...].
  get moves() {
    return [...this.by].map(([piece, by]) => ({ piece, cells: piece.all, by }));
  }

  // The move of what stands at a point of the room as it is now, and where the point was before.
  origin(point) {
    const { grid } = this.furniture;
    for (const [piece, by] of this.by) {
      const before = [point[0] - by[0] * grid.voxel, point[1], point[2] - by[1] * grid.voxel];
      if (this.furniture.find(before).piece === piece) return { piece, before };
    }
    const { piece, reason } = this.furniture.find(point);
    if (this.by.has(piece))
      return { reason: 'Nothing stands here: press on a piece of furniture.', before: point };
    return { piece, reason, before: point };
  }

  // Where a place was before what it is on was moved.
  before([x, z], top) {
    const [x0, , z0] = this.origin([x, top, z]).before;
    return [x0, z0];
  }

  // Take up what a press meets, [x, z] and its height above the floor. Returns why it cannot, or null.
  pick({ place: [x, z], up }) {
    const { piece, reason } = this.origin([x, this.furniture.floor + up, z]);
    if (!piece) return reason;
    const ridden = this.ridden(piece);
    if (ridden) return ridden;
    const from = this.by.get(piece) ?? [0, 0];
    this.held = { piece, from, by: from, grasp: [x, z] };
    this.show();
    return null;
  }

  // The bodies that furniture is not set down on.
  get bodies() {
    const { present, observer } = this.home;
    return [
      ...present.map(({ name, place: [x, y, z] }) => ({ name: `${name} is`, place: [x, z], height: y })),
      { name: 'You are', place: observer.place, height: -Infinity },
    ];
  }

  // Why a piece cannot be moved at all now, or null.
  ridden(piece) {
    const rider = this.bodies.find((body) => this.isOn(piece, body));
    return rider ? `${rider.name} on it.` : null;
  }

  // Whether an animal is upon a piece, and not beneath a part of it as under a table.
  isOn(piece, { place: [x, z], height }) {
    const { grid } = this.furniture;
    const [da, dc] = this.by.get(piece) ?? [0, 0];
    const column = grid.movedColumn(Math.max(0, grid.columnAt(x, z)), [-da, -dc]);
    const heights = piece.cells
      .filter((cell) => grid.column(cell) === column)
      .map((cell) => grid.center(cell)[1]);
    return heights.length > 0 && Math.max(...heights) < height;
  }

  // Carry it to where the pointer is on the floor, or by voxels.
  drag([x, z]) {
    if (!this.held) return; // a key has set it down
    const { from, grasp } = this.held;
    const { voxel } = this.furniture.grid;
    this.held.by = [
      from[0] + Math.round((x - grasp[0]) / voxel),
      from[1] + Math.round((z - grasp[1]) / voxel),
    ];
    this.show();
  }

  nudge([da, dc]) {
    const { by } = this.held;
    this.held.by = [by[0] + da, by[1] + dc];
    this.show();
  }

  show() {
    const { held } = this;
    const still = !held || String(held.by) === String(held.from);
    const refused = still ? null : this.refusal(held);
    this.view.carry(held, refused);
    if (!still) panel.help(refused ?? 'It can stand here.');
  }

  refusal({ piece, by }, others = this.moves.filter((move) => move.piece !== piece)) {
    return this.ridden(piece) ?? this.furniture.refusal(piece, by, others, this.bodies, APART_M);
  }

  // Set it down. Where that cannot be it goes back to where it was taken up.
  drop() {
    const { held } = this;
    if (!held) return;
    const refused = this.refusal(held);
    this.cancel();
    if (String(held.by) === String(held.from)) return;
    if (refused) return this.say(`${refused} It is back where it was.`);
    this.past.push({ piece: held.piece, by: held.from });
    this.put(held.piece, held.by);
    this.apply();
    this.say('Moved: the animals see it there and plan around it.');
  }

  cancel() {
    this.held = null;
    this.show();
  }

  put(piece, by) {
    if (by.some(Boolean)) this.by.set(piece, by);
    else this.by.delete(piece);
  }

  undo() {
    const last = this.past.at(-1);
    if (!last || this.held) return;
    const refused = this.refusal(last);
    if (refused) return this.say(`This cannot be undone now. ${refused}`);
    this.past.pop();
    this.put(last.piece, last.by);
    this.apply();
    this.say('Undone.');
  }

  // Put everything back to where it was recorded.
  restore() {
    if (this.held) this.cancel();
    const refused = [...this.by.keys()].map((piece) => this.refusal({ piece, by: [0, 0] }, [])).find(Boolean);
    if (refused) return this.say(`Not everything can be put back now. ${refused}`);
    this.by.clear();
    this.past = [];
    this.apply();
    this.say('All furniture is back where it was recorded.');
  }

  // The piece that is next by its distance to the person, for those who press no pointer.
  pickNext() {
    const { grid, floor, pieces } = this.furniture;
    const [x, z] = this.home.observer.place;
    const away = (piece) => {
      const [px, pz] = grid.columnCenter(piece.columns[Math.floor(piece.columns.length / 2)]);
      return Math.hypot(px - x, pz - z);
    };
    const order = pieces.filter((piece) => this.furniture.isMovable(piece)).sort((a, b) => away(a) - away(b));
    if (!order.length) return this.say('There is nothing here that can be moved.');
    const piece = order[(order.indexOf(this.held?.piece) + 1) % order.length];
    const by = this.by.get(piece) ?? [0, 0];
    const top = grid.moved(piece.cells.at(-1), by);
    const [tx, ty, tz] = grid.center(top);
    this.held = null;
    const reason = this.pick({ place: [tx, tz], up: ty - floor });
    this.say(
      reason ?? `Furniture ${away(piece).toFixed(1)} meters away: arrows move it, Enter sets it down.`,
    );
  }

  // Tell everybody.
  apply() {
    const { home, moves } = this;
    for (const own of this.homes) this.furnish(own, moves);
    this.view.arrange(moves);
    home.state.moved = this.text;
    home.rearranged(moves.length > 0);
  }

  // One animal's own volume, in which the same space may have other numbers.
  furnish(own, moves) {
    const { resident, grid, level } = own;
    const same = moves.map(({ cells, by }) => ({ cells: sameCells(cells, this.furniture.grid, grid), by }));
    const { allowed } = arranged(own, same);
    const standing = Math.floor((resident.contract.agent.standing_m - grid.origin[1]) / grid.voxel);
    const band = [level, Math.max(level, standing) + 1];
    const { volume } = resident.contract;
    own.arrangement = { animal: resident.index, moves: same, allowed, band };
    resident.rearranged(
      new Support(volume, allowed),
      same.length ? new Detour(volume, allowed, same, band) : null,
    );
    this.home.planner?.furnish(own.arrangement);
  }

  // For a planner that was not there yet.
  inform() {
    for (const { arrangement } of this.homes)
      if (arrangement?.moves.length) this.home.planner.furnish(arrangement);
  }

  // Whether moved furniture stands where a person would.
  stands([x, z]) {
    const { grid } = this.furniture;
    const reach = Math.ceil(PERSON_M / grid.voxel);
    const here = grid.columnAt(x, z);
    const range = Array.from({ length: 2 * reach + 1 }, (_, i) => i - reach);
    return [...this.by].some(([piece, [da, dc]]) =>
      range.some((i) =>
        range.some((k) => {
          const column = grid.movedColumn(here, [i, k]);
          if (here < 0 || column < 0) return false;
          const [cx, cz] = grid.columnCenter(column);
          const gap = [Math.abs(cx - x), Math.abs(cz - z)].map((far) => Math.max(0, far - grid.voxel / 2));
          return Math.hypot(...gap) < PERSON_M && piece.footprint.has(grid.movedColumn(column, [-da, -dc]));
        }),
      ),
    );
  }

  // A seed's moment to begin from, or that of the next seed at which nothing stands where somebody begins.
  beginning(seed, moment) {
    for (let more = 0; more < BEGINNINGS; more++) {
      const found = moment(seed + more);
      const [root, { observer }] = [found.frames.at(-1), found];
      if (!this.stands([root[0], root[2]]) && !this.stands([observer[0], observer[2]])) return found;
    }
    return moment(seed);
  }

  // What has been moved, as the address keeps it: a voxel of each piece and its move, meters.
  get text() {
    const { grid } = this.furniture;
    return [...this.by]
      .map(([piece, by]) => [...grid.center(piece.seed), ...by.map((value) => value * grid.voxel)])
      .map((numbers) => numbers.map(meters).join(','))
      .join(';');
  }

  // Move what an address says, [[x, y, z, dx, dz], ...]. Returns how many of these mean nothing here.
  read(entries) {
    const { grid, owner, pieces } = this.furniture;
    const before = this.text;
    if (this.held) this.cancel();
    this.by.clear();
    this.past = [];
    let lost = 0;
    for (const [x, y, z, dx, dz] of entries) {
      const piece = pieces[(owner[grid.at([x, y, z])] ?? 0) - 1];
      const by = [dx, dz].map((value) => Math.round(value / grid.voxel));
      if (!piece || this.by.has(piece) || this.furniture.refusal(piece, by, this.moves, [], 0)) lost += 1;
      else this.put(piece, by);
    }
    if (this.text !== before) this.apply();
    this.home.state.moved = this.text;
    return lost;
  }

  say(text) {
    panel.help(text, 5);
    panel.say(text);
  }
}
