// Floor that nobody recorded: a flat sheet where the animal may walk all the same, dotted so that it is not
// taken for seen.

import * as THREE from 'three';

const FILLED = 3; // mark of a voxel above such floor, as in pipeline/behavior/support.py
const LIFT_M = 0.004;
const OPACITY = 0.35;
const DOT = 0.5; // of a voxel's edge

// A mesh for the volume's marks, or null where all floor was seen. floor: its height.
export function filledFloor({ shape: [, vx, vy, vz], origin, voxel_m: voxel }, marks, floor) {
  const places = [];
  for (let a = 0; a < vx; a++)
    for (let c = 0; c < vz; c++)
      for (let b = 0; b < vy; b++) {
        if (marks[(a * vy + b) * vz + c] === FILLED)
          places.push([origin[0] + (a + 0.5) * voxel, origin[2] + (c + 0.5) * voxel]);
      }
  if (!places.length) return null;
  const dot = new THREE.CircleGeometry((DOT * voxel) / 2, 12).rotateX(-Math.PI / 2);
  const sheet = new THREE.InstancedMesh(
    dot,
    new THREE.MeshBasicMaterial({ color: 0x8d857a, transparent: true, opacity: OPACITY, depthWrite: false }),
    places.length,
  );
  const matrix = new THREE.Matrix4();
  places.forEach(([x, z], i) => sheet.setMatrixAt(i, matrix.makeTranslation(x, floor + LIFT_M, z)));
  sheet.frustumCulled = false;
  sheet.renderOrder = 0.7;
  return sheet;
}
