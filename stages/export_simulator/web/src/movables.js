// Furniture as it is drawn: the triangles and splats of each piece, moved; floor where it stood; and a
// translucent copy of what is being carried.

import * as THREE from 'three';
import { utils } from '@sparkjsdev/spark';
import { filledFloor, sheet } from './floor.js';

const LIFT_M = 0.006;
const BELOW_M = 0.01; // so far below its height the filled floor hides beneath what was seen of it
const PROBES = [
  [0, 0],
  [0.4, 0.4],
  [-0.4, 0.4],
  [0.4, -0.4],
  [-0.4, -0.4],
]; // of a voxel's edge
const SEEN_M = 0.08; // the mesh within this of the floor's height is floor
const AROUND_M = 0.5; // from there the floor's color is taken
const [FITS, REFUSED] = [0x3f7f5f, 0xb03a2e];

export class Movables {
  constructor(room, furniture) {
    Object.assign(this, { room, furniture, parts: [] });
    this.patch = new THREE.Group();
    this.carried = new THREE.Group();
    this.carried.renderOrder = 4;
    room.scene.add(this.patch, this.carried);
  }

  // Which piece each triangle of the room goes with, found when it is first asked for.
  get triangles() {
    if (this.of) return this.of;
    const { geometry } = this.room.mesh;
    const { position } = geometry.attributes;
    this.index = geometry.index;
    const owner = Array.from({ length: position.count }, (_, i) =>
      this.furniture.pieceAt([position.getX(i), position.getY(i), position.getZ(i)]),
    );
    const corners = this.index.array;
    this.of = Int32Array.from({ length: corners.length / 3 }, (_, i) => {
      const [a, b, c] = [owner[corners[3 * i]], owner[corners[3 * i + 1]], owner[corners[3 * i + 2]]];
      return a === b || a === c ? a : b === c ? b : 0;
    });
    return this.of;
  }

  // The room's surface with the triangles alone that are wanted; vertices are shared.
  surface(wanted) {
    const of = this.triangles;
    const geometry = new THREE.BufferGeometry();
    Object.assign(geometry.attributes, this.room.mesh.geometry.attributes);
    geometry.setIndex(this.subset((triangle) => wanted(of[triangle])));
    return geometry;
  }

  subset(wanted) {
    const corners = this.index.array;
    const kept = Array.from(this.of.keys()).filter(wanted);
    const out = new corners.constructor(3 * kept.length);
    kept.forEach((triangle, i) => out.set(corners.subarray(3 * triangle, 3 * triangle + 3), 3 * i));
    return new THREE.BufferAttribute(out, 1);
  }

  offset([da, dc]) {
    const { voxel } = this.furniture.grid;
    return new THREE.Vector3(da * voxel, 0, dc * voxel);
  }

  // Draw the room with pieces moved, [{piece, by}, ...].
  arrange(moves) {
    const { mesh } = this.room;
    const of = this.triangles;
    for (const part of this.parts) {
      mesh.remove(part);
      part.geometry.dispose();
    }
    const moved = new Set(moves.map(({ piece }) => piece.number));
    mesh.geometry.setIndex(moves.length ? this.subset((triangle) => !moved.has(of[triangle])) : this.index);
    this.parts = moves.map(({ piece, by }) => {
      const part = new THREE.Mesh(
        this.surface((number) => number === piece.number),
        mesh.material,
      );
      part.position.copy(this.offset(by));
      part.layers.mask = mesh.layers.mask;
      part.renderOrder = mesh.renderOrder;
      mesh.add(part);
      return part;
    });
    mesh.updateWorldMatrix(true, true);
    this.fillFloor(moves);
    this.moveSplats(moves);
    this.room.redraw();
  }

  // A plane of the floor's color where furniture stood and no floor was seen, dotted as other such floor.
  fillFloor(moves) {
    const { grid, floor } = this.furniture;
    for (const child of [...this.patch.children]) {
      this.patch.remove(child);
      child.geometry.dispose();
      child.material.dispose();
    }
    for (const { piece } of moves) {
      const places = this.furniture.around(piece).map((column) => grid.columnCenter(column));
      const uncovered = places.filter(([x, z]) =>
        PROBES.some(([dx, dz]) => !this.seesFloor(x + dx * grid.voxel, z + dz * grid.voxel)),
      );
      if (!uncovered.length) continue;
      const holes = uncovered.filter(([x, z]) => !this.seesFloor(x, z));
      const square = new THREE.PlaneGeometry(grid.voxel, grid.voxel).rotateX(-Math.PI / 2);
      const material = new THREE.MeshBasicMaterial({ color: this.floorColor(uncovered) });
      this.patch.add(
        sheet(square, material, uncovered, floor - BELOW_M),
        filledFloor(holes, grid.voxel, floor),
      );
    }
  }

  seesFloor(x, z) {
    const { floor } = this.furniture;
    const ray = new THREE.Raycaster(new THREE.Vector3(x, floor + SEEN_M, z), new THREE.Vector3(0, -1, 0));
    ray.far = 2 * SEEN_M;
    ray.layers.enableAll();
    return ray.intersectObject(this.room.mesh, false).length > 0;
  }

  // The mean color of the floor around some places.
  floorColor(places) {
    const { position, color } = this.room.mesh.geometry.attributes;
    const { floor } = this.furniture;
    const [xs, zs] = [0, 1].map((axis) => places.map((place) => place[axis]));
    const [low, high] = [Math.min, Math.max].map((end) => [end(...xs), end(...zs)]);
    const [sum, all] = [new THREE.Vector3(), new THREE.Vector3()];
    let [near, count] = [0, 0];
    for (let i = 0; i < position.count; i++) {
      if (Math.abs(position.getY(i) - floor) > SEEN_M / 2) continue;
      const tint = new THREE.Vector3().fromBufferAttribute(color, i);
      all.add(tint);
      count += 1;
      const [x, z] = [position.getX(i), position.getZ(i)];
      if (x < low[0] - AROUND_M || x > high[0] + AROUND_M || z < low[1] - AROUND_M || z > high[1] + AROUND_M)
        continue;
      sum.add(tint);
      near += 1;
    }
    const mean = near ? sum.divideScalar(near) : all.divideScalar(count || 1);
    return new THREE.Color(mean.x, mean.y, mean.z);
  }

  moveSplats(moves) {
    const { splats } = this.room;
    if (!splats) return;
    const packed = splats.packedSplats;
    this.words ??= packed.packedArray.slice();
    this.splatOf ??= Array.from({ length: packed.numSplats }, (_, i) =>
      this.furniture.pieceAt(packed.getSplat(i).center.toArray()),
    );
    packed.packedArray.set(this.words);
    const by = new Map(moves.map((move) => [move.piece.number, this.offset(move.by)]));
    this.splatOf.forEach((number, i) => {
      if (!by.has(number)) return;
      const { x, y, z } = packed.getSplat(i).center.add(by.get(number));
      utils.setPackedSplatCenter(packed.packedArray, i, x, y, z);
    });
    packed.needsUpdate = true;
    splats.updateVersion();
  }

  // Show what is carried at a move from where it was recorded, and where it would stand; with null nothing.
  carry(held, refused) {
    const { carried } = this;
    if (!held || held.piece !== this.shown) {
      for (const child of [...carried.children]) {
        carried.remove(child);
        child.geometry.dispose();
        child.material.dispose();
      }
      this.shown = held?.piece;
      if (held) this.lift(held.piece);
    }
    if (!held) return;
    carried.position.copy(this.offset(held.by));
    for (const { material } of carried.children) material.color.setHex(refused ? REFUSED : FITS);
  }

  lift({ number, columns }) {
    const { grid, floor } = this.furniture;
    const translucent = { transparent: true, depthWrite: false };
    const body = new THREE.Mesh(
      this.surface((each) => each === number),
      new THREE.MeshBasicMaterial({ ...translucent, opacity: 0.55, side: THREE.DoubleSide }),
    );
    const square = new THREE.PlaneGeometry(grid.voxel, grid.voxel).rotateX(-Math.PI / 2);
    const places = columns.map((column) => grid.columnCenter(column));
    const shade = new THREE.MeshBasicMaterial({ ...translucent, opacity: 0.6 });
    const footprint = sheet(square, shade, places, floor + LIFT_M);
    body.frustumCulled = false;
    body.renderOrder = footprint.renderOrder = 4;
    this.carried.add(footprint, body);
  }
}
