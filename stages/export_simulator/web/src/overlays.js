// The plan, drawn on the floor: the fan of sampled goals, the chosen goal, the path ribbon.

import * as THREE from 'three';

const MAX_GOALS = 16;
const LIFT_M = 0.025;

export class Overlays {
  // floor: its height; crouch: height of the root above what it stands on, at least. Meters.
  constructor(scene, floor, crouch) {
    this.floor = floor;
    this.group = new THREE.Group();
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
      new THREE.BufferGeometry().setAttribute(
        'position',
        new THREE.BufferAttribute(new Float32Array(MAX_GOALS * 6), 3),
      ),
      new THREE.LineBasicMaterial({ color: 0xc8722b, transparent: true, opacity: 0.3, depthWrite: false }),
    );
    this.fan.frustumCulled = false;
    this.ribbon = ribbon();
    this.route = ribbon(0xc8722b);
    this.commands = new THREE.Group();
    for (const node of [this.goals, this.chosen, this.fan, this.ribbon, this.route, this.commands]) {
      node.renderOrder = 3;
      node.visible = false;
      this.group.add(node);
    }
    scene.add(this.group);
    this.layers = { goals: true, path: true };
  }

  // goals: points in the world; chosen: index; path: points; all meters.
  show(plan) {
    this.plan = plan;
    const count = Math.min(MAX_GOALS, plan.goals.length);
    const matrix = new THREE.Matrix4();
    for (let i = 0; i < count; i++) {
      this.goals.setMatrixAt(
        i,
        matrix.makeTranslation(plan.goals[i][0], this.ground(plan.goals[i]), plan.goals[i][2]),
      );
    }
    this.goals.count = count;
    this.goals.instanceMatrix.needsUpdate = true;
    const goal = plan.goals[plan.chosen];
    this.chosen.position.set(goal[0], this.ground(goal) + 0.004, goal[2]);
    fillRibbon(this.ribbon, plan.path, this.ground);
    this.refresh();
  }

  // A path that the visitor draws or has drawn, [[x, z], ...] or null; and goals, [[x, z, up], ...].
  ask(route, goals = []) {
    const height = this.floor + LIFT_M;
    this.route.visible = Boolean(route && route.length > 1);
    if (this.route.visible) {
      const every = Math.ceil(route.length / 250);
      fillRibbon(
        this.route,
        route.filter((_, i) => i % every === 0 || i === route.length - 1).map(([x, z]) => [x, this.floor, z]),
        () => height + 0.003,
        0,
      );
    }
    while (this.commands.children.length < goals.length) this.commands.add(commandMarker());
    this.commands.visible = goals.length > 0;
    this.commands.children.forEach((node, i) => {
      node.visible = i < goals.length;
      if (node.visible) node.position.set(goals[i][0], height + 0.004 + (goals[i][2] ?? 0), goals[i][1]);
    });
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

function ribbon(color = 0x4c8067) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(256 * 6), 3));
  geometry.setAttribute('color', new THREE.BufferAttribute(new Float32Array(256 * 8), 4));
  const index = [];
  for (let i = 0; i < 255; i++) index.push(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 1, 2 * i + 3, 2 * i + 2);
  geometry.setIndex(index);
  const mesh = new THREE.Mesh(
    geometry,
    new THREE.MeshBasicMaterial({
      vertexColors: true,
      transparent: true,
      depthWrite: false,
      side: THREE.DoubleSide,
    }),
  );
  mesh.frustumCulled = false;
  mesh.userData.tint = new THREE.Color(color);
  return mesh;
}

// The visitor's goal: a flat cross in a ring.
function commandMarker() {
  const material = new THREE.MeshBasicMaterial({
    color: 0x2d2b28,
    transparent: true,
    opacity: 0.9,
    depthWrite: false,
  });
  const group = new THREE.Group();
  group.add(new THREE.Mesh(new THREE.RingGeometry(0.15, 0.17, 40).rotateX(-Math.PI / 2), material));
  for (const angle of [Math.PI / 4, -Math.PI / 4])
    group.add(
      new THREE.Mesh(new THREE.PlaneGeometry(0.2, 0.024).rotateX(-Math.PI / 2).rotateY(angle), material),
    );
  return group;
}

function fillRibbon(mesh, path, ground, fade = 0.7) {
  const { position, color } = mesh.geometry.attributes;
  const { tint } = mesh.userData;
  const count = Math.min(256, path.length);
  let [sideX, sideZ] = [0, 0];
  for (let i = 0; i < count; i++) {
    const before = path[Math.max(0, i - 2)],
      after = path[Math.min(count - 1, i + 2)];
    const [dx, dz] = [after[0] - before[0], after[2] - before[2]];
    const length = Math.hypot(dx, dz);
    if (length > 1e-3) [sideX, sideZ] = [(-dz / length) * 0.028, (dx / length) * 0.028];
    const height = ground(path[i]);
    position.setXYZ(2 * i, path[i][0] + sideX, height, path[i][2] + sideZ);
    position.setXYZ(2 * i + 1, path[i][0] - sideX, height, path[i][2] - sideZ);
    const alpha = 0.85 * (1 - fade * (i / count));
    color.setXYZW(2 * i, tint.r, tint.g, tint.b, alpha);
    color.setXYZW(2 * i + 1, tint.r, tint.g, tint.b, alpha);
  }
  mesh.geometry.setDrawRange(0, Math.max(0, count - 1) * 6);
  position.needsUpdate = color.needsUpdate = true;
}
