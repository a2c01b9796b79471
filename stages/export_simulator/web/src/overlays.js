// What the animal has in mind, drawn on the floor: the fan of sampled goals, the chosen goal, the path ribbon.

import * as THREE from 'three';

const MAX_GOALS = 16;
const LIFT_M = 0.025;

export class Overlays {
  // floor: its height; crouch: height of the root above what it stands on, at least. Metres.
  constructor(scene, floor, crouch) {
    this.floor = floor;
    this.ground = (point) => Math.max(floor, point[1] - crouch) + LIFT_M;
    this.goals = new THREE.InstancedMesh(
      new THREE.CircleGeometry(0.075, 24).rotateX(-Math.PI / 2),
      new THREE.MeshBasicMaterial({ color: 0xc8722b, transparent: true, opacity: 0.34, depthWrite: false }),
      MAX_GOALS,
    );
    this.goals.frustumCulled = false;
    this.chosen = new THREE.Mesh(
      new THREE.RingGeometry(0.1, 0.135, 40).rotateX(-Math.PI / 2),
      new THREE.MeshBasicMaterial({ color: 0xc8722b, transparent: true, opacity: 0.95, depthWrite: false }),
    );
    this.fan = new THREE.LineSegments(
      new THREE.BufferGeometry().setAttribute('position', new THREE.BufferAttribute(new Float32Array(MAX_GOALS * 6), 3)),
      new THREE.LineBasicMaterial({ color: 0xc8722b, transparent: true, opacity: 0.3, depthWrite: false }),
    );
    this.fan.frustumCulled = false;
    this.ribbon = ribbon();
    for (const node of [this.goals, this.chosen, this.fan, this.ribbon]) {
      node.renderOrder = 3;
      node.visible = false;
      scene.add(node);
    }
    this.layers = { goals: true, path: true };
  }

  // goals: points in the world; chosen: index; path: points; all metres.
  show(plan) {
    this.plan = plan;
    const count = Math.min(MAX_GOALS, plan.goals.length);
    const matrix = new THREE.Matrix4();
    for (let i = 0; i < count; i++) {
      this.goals.setMatrixAt(i, matrix.makeTranslation(plan.goals[i][0], this.ground(plan.goals[i]), plan.goals[i][2]));
    }
    this.goals.count = count;
    this.goals.instanceMatrix.needsUpdate = true;
    const goal = plan.goals[plan.chosen];
    this.chosen.position.set(goal[0], this.ground(goal) + 0.004, goal[2]);
    fillRibbon(this.ribbon, plan.path, this.ground);
    this.refresh();
  }

  // Keep the fan rooted in the moving animal.
  follow(root) {
    if (!this.plan) return;
    const points = this.fan.geometry.attributes.position;
    const count = this.goals.count;
    for (let i = 0; i < count; i++) {
      const goal = this.plan.goals[i];
      points.setXYZ(2 * i, root[0], this.ground(root), root[2]);
      points.setXYZ(2 * i + 1, goal[0], this.ground(goal), goal[2]);
    }
    this.fan.geometry.setDrawRange(0, 2 * count);
    points.needsUpdate = true;
  }

  refresh() {
    const shown = Boolean(this.plan);
    this.goals.visible = this.fan.visible = this.chosen.visible = shown && this.layers.goals;
    this.ribbon.visible = shown && this.layers.path;
  }
}

function ribbon() {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(256 * 6), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(256 * 8), 4));
  const index = [];
  for (let i = 0; i < 255; i++) index.push(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 1, 2 * i + 3, 2 * i + 2);
  geometry.setIndex(index);
  const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false, side: THREE.DoubleSide }));
  mesh.frustumCulled = false;
  return mesh;
}

function fillRibbon(mesh, path, ground) {
  const { position, color } = mesh.geometry.attributes;
  const tint = new THREE.Color(0x4c8067);
  const count = Math.min(256, path.length);
  let [sideX, sideZ] = [0, 0];
  for (let i = 0; i < count; i++) {
    const before = path[Math.max(0, i - 2)], after = path[Math.min(count - 1, i + 2)];
    const [dx, dz] = [after[0] - before[0], after[2] - before[2]];
    const length = Math.hypot(dx, dz);
    if (length > 1e-3) [sideX, sideZ] = [(-dz / length) * 0.028, (dx / length) * 0.028];
    const height = ground(path[i]);
    position.setXYZ(2 * i, path[i][0] + sideX, height, path[i][2] + sideZ);
    position.setXYZ(2 * i + 1, path[i][0] - sideX, height, path[i][2] - sideZ);
    const alpha = 0.85 * (1 - 0.7 * (i / count));
    color.setXYZW(2 * i, tint.r, tint.g, tint.b, alpha);
    color.setXYZW(2 * i + 1, tint.r, tint.g, tint.b, alpha);
  }
  mesh.geometry.setDrawRange(0, Math.max(0, count - 1) * 6);
  position.needsUpdate = color.needsUpdate = true;
}
