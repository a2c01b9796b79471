// The person with the phone: a figure to drag or walk, and the last poses of the phone at 10 Hz.

import * as THREE from 'three';
import { lookAt } from './rigid.js';

export const WALK_M_S = 1.1;
const DRAG_M_S = 2.5;

export class Observer {
  constructor(contract, color = 0x2f6f9f) {
    this.floor = contract.scene.floor_m;
    this.eye = contract.observer.eye_height_m;
    this.bounds = contract.scene.bounds_m;
    this.figure = person(this.eye, color);
    this.place = [...contract.observer.start_m];
    this.target = null;
    this.history = [];
    this.animal = [0, this.floor, 0];
    this.settle();
  }

  // Walk by a direction in the view's heading, or towards the dragged point.
  step(seconds, direction, heading) {
    let [dx, dz] = [0, 0];
    if (direction[0] || direction[1]) {
      const length = Math.hypot(...direction);
      const [right, ahead] = [direction[0] / length, direction[1] / length];
      dx = WALK_M_S * seconds * (ahead * Math.sin(heading) - right * Math.cos(heading));
      dz = WALK_M_S * seconds * (ahead * Math.cos(heading) + right * Math.sin(heading));
      this.target = null;
    } else if (this.target) {
      const [x, z] = [this.target[0] - this.place[0], this.target[1] - this.place[1]];
      const share = Math.min(1, (DRAG_M_S * seconds) / (Math.hypot(x, z) || 1));
      [dx, dz] = [x * share, z * share];
    }
    const [low, high] = this.bounds;
    this.place = [
      Math.min(high[0] - 0.15, Math.max(low[0] + 0.15, this.place[0] + dx)),
      Math.min(high[2] - 0.15, Math.max(low[2] + 0.15, this.place[1] + dz)),
    ];
    this.figure.position.set(this.place[0], this.floor, this.place[1]);
    this.figure.rotation.y = Math.atan2(this.animal[0] - this.place[0], this.animal[2] - this.place[1]);
    return Math.hypot(dx, dz) > 1e-5;
  }

  // The phone's pose: at eye height, looking at the animal.
  pose(place = this.place) {
    return lookAt([place[0], this.floor + this.eye, place[1]], [this.animal[0], this.animal[1], this.animal[2]]);
  }

  tick() {
    this.history.push(this.pose());
    if (this.history.length > 16) this.history.shift();
  }

  // Forget the walk: stand here as if for a while.
  settle() {
    this.history = Array.from({ length: 16 }, () => this.pose());
    this.step(0, [0, 0], 0);
  }
}

function person(eye, color) {
  const group = new THREE.Group();
  const cloth = new THREE.MeshLambertMaterial({ color, transparent: true, opacity: 0.82 });
  const skin = new THREE.MeshLambertMaterial({ color: 0xf0dccb });
  const shoulders = eye - 0.16;
  const profile = [[0.02, 0], [0.13, 0.01], [0.15, 0.06], [0.12, 0.5 * shoulders], [0.17, 0.86 * shoulders], [0.12, 0.97 * shoulders], [0.03, shoulders]];
  const body = new THREE.Mesh(new THREE.LatheGeometry(profile.map(([r, y]) => new THREE.Vector2(r, y)), 24), cloth);
  const head = new THREE.Mesh(new THREE.SphereGeometry(0.105, 24, 16), skin);
  head.position.y = eye + 0.01;
  const phone = new THREE.Mesh(new THREE.BoxGeometry(0.08, 0.16, 0.012), new THREE.MeshLambertMaterial({ color: 0x2d2b28 }));
  phone.position.set(0, eye - 0.12, 0.27);
  const ring = new THREE.Mesh(new THREE.RingGeometry(0.24, 0.27, 40).rotateX(-Math.PI / 2), new THREE.MeshBasicMaterial({ color, transparent: true, opacity: 0.6 }));
  ring.position.y = 0.015;
  group.add(body, head, phone, ring);
  return group;
}
