// The person with the phone: a figure to drag or walk.

import * as THREE from 'three';
import { lookAt } from './rigid.js';

export const WALK_M_S = 1.1;
const DRAG_M_S = 2.5;
const WALL_M = 0.15; // kept from the edges of the room
const LOOK_M = 0.05; // between places on a step that are tested
const APART_M = 0.36; // kept from the animal: nobody walks through anybody

export class Observer {
  constructor(contract, color = 0x2f6f9f) {
    this.floor = contract.scene.floor_m;
    this.eye = contract.observer.eye_height_m;
    this.bounds = contract.scene.bounds_m;
    this.figure = person(this.eye, color);
    this.place = [...contract.observer.start_m];
    this.target = null;
    this.animal = [0, this.floor, 0]; // the one that the person looks at
    this.animals = []; // where all are
    this.stands = () => false; // whether something stands at [x, z] that a person cannot walk through
    this.step(0, [0, 0], 0);
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
    if (dx || dz) this.place = this.apart([this.place[0] + dx, this.place[1] + dz]);
    const [low, high] = this.bounds;
    this.place = [0, 1].map((axis) =>
      Math.min(high[2 * axis] - WALL_M, Math.max(low[2 * axis] + WALL_M, this.place[axis])),
    );
    this.figure.position.set(this.place[0], this.floor, this.place[1]);
    this.figure.rotation.y = Math.atan2(this.animal[0] - this.place[0], this.animal[2] - this.place[1]);
    return Math.hypot(dx, dz) > 1e-5;
  }

  // A step that would lead into an animal or into moved furniture ends beside it; who stands there already may
  // step back.
  apart(place) {
    return this.around(this.animals.reduce((kept, animal) => this.beside(kept, animal), place));
  }

  // Along the side of what stands in the way, if one side is free.
  around([x, z]) {
    const ways = [
      [x, z],
      [x, this.place[1]],
      [this.place[0], z],
    ];
    return this.stands(this.place) ? [x, z] : (ways.find((way) => !this.meets(way)) ?? this.place);
  }

  meets(to) {
    const [dx, dz] = [0, 1].map((axis) => to[axis] - this.place[axis]);
    const count = Math.ceil(Math.hypot(dx, dz) / LOOK_M);
    return Array.from({ length: count }, (_, i) => (i + 1) / count).some((share) =>
      this.stands([this.place[0] + share * dx, this.place[1] + share * dz]),
    );
  }

  beside([x, z], animal) {
    const gap = (place) => Math.hypot(place[0] - animal[0], place[1] - animal[2]);
    const reach = Math.min(APART_M, gap(this.place));
    const distance = gap([x, z]);
    if (distance >= reach || distance < 1e-6) return distance < 1e-6 ? this.place : [x, z];
    return [
      animal[0] + ((x - animal[0]) * reach) / distance,
      animal[2] + ((z - animal[2]) * reach) / distance,
    ];
  }

  // The phone's pose: at eye height, looking at an animal.
  pose(place = this.place, animal = this.animal) {
    return lookAt([place[0], this.floor + this.eye, place[1]], [animal[0], animal[1], animal[2]]);
  }
}

// A pawn as tall as the person, with a phone held out: seen at a glance, in the way of nothing.
function person(eye, color) {
  const group = new THREE.Group();
  const cloth = new THREE.MeshLambertMaterial({ color, transparent: true, opacity: 0.8 });
  const tall = eye - 0.2;
  const profile = [
    [0, 0],
    [0.19, 0],
    [0.195, 0.02],
    [0.16, 0.3 * tall],
    [0.115, 0.62 * tall],
    [0.1, 0.84 * tall],
    [0.115, 0.9 * tall],
    [0.1, 0.96 * tall],
    [0, tall],
  ];
  const curve = new THREE.SplineCurve(profile.slice(2).map(([r, y]) => new THREE.Vector2(r, y)));
  const outline = [new THREE.Vector2(0.001, 0), new THREE.Vector2(0.19, 0), ...curve.getPoints(28)];
  const body = new THREE.Mesh(new THREE.LatheGeometry(outline, 32), cloth);
  const head = new THREE.Mesh(new THREE.SphereGeometry(0.115, 28, 20), cloth);
  head.position.y = eye - 0.06;
  const phone = new THREE.Mesh(
    new THREE.BoxGeometry(0.075, 0.15, 0.012),
    new THREE.MeshLambertMaterial({ color: 0x2d2b28 }),
  );
  phone.position.set(0, eye - 0.16, 0.24);
  // A face towards the front, where the phone is.
  const dark = new THREE.MeshLambertMaterial({ color: 0x2d2b28 });
  const features = [
    [-0.042, 0.02, 0.102, 0.016],
    [0.042, 0.02, 0.102, 0.016],
    [0, -0.012, 0.118, 0.02],
  ].map(([x, y, z, size], i) => {
    const feature = new THREE.Mesh(new THREE.SphereGeometry(size, 12, 10), i < 2 ? dark : cloth);
    feature.position.set(x, eye - 0.06 + y, z);
    return feature;
  });
  const ring = new THREE.Mesh(
    new THREE.RingGeometry(0.25, 0.275, 48).rotateX(-Math.PI / 2),
    new THREE.MeshBasicMaterial({ color, transparent: true, opacity: 0.55 }),
  );
  ring.position.y = 0.015;
  group.add(body, head, phone, ring, ...features);
  return group;
}
