// Floor that nobody recorded: a flat sheet where the animal may walk all the same, dotted so that it is not
// taken for seen.

import * as THREE from 'three';

const FILLED = 3; // mark of a voxel above such floor, as in pipeline/behavior/support.py
const LIFT_M = 0.004;
const OPACITY = 0.35;
const DOT = 0.5; // of a voxel's edge

// The places [x, z] of the volume's marks.
export function filledPlaces({ shape: [, vx, vy, vz], origin, voxel_m: voxel }, marks) {
  const places = [];
  for (let a = 0; a < vx; a++)
    for (let c = 0; c < vz; c++)
      for (let b = 0; b < vy; b++) {
        if (marks[(a * vy + b) * vz + c] === FILLED)
          places.push([origin[0] + (a + 0.5) * voxel, origin[2] + (c + 0.5) * voxel]);
      }
  return places;
}

// Dots at some places. floor: its height.
export function filledFloor(places, voxel, floor) {
  const dot = new THREE.CircleGeometry((DOT * voxel) / 2, 12).rotateX(-Math.PI / 2);
  const material = new THREE.MeshBasicMaterial({
    color: 0x8d857a,
    transparent: true,
    opacity: OPACITY,
    depthWrite: false,
  });
  return sheet(dot, material, places, floor + LIFT_M);
}

// One flat shape, many times.
export function sheet(geometry, material, places, height) {
  const mesh = new THREE.InstancedMesh(geometry, material, places.length);
  const matrix = new THREE.Matrix4();
  places.forEach(([x, z], i) => mesh.setMatrixAt(i, matrix.makeTranslation(x, height, z)));
  mesh.frustumCulled = false;
  mesh.renderOrder = 0.7;
  return mesh;
}
