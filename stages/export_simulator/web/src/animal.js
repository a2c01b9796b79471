// Skinned bodies: the animal itself, its ghost at the end of the plan, and a real animal beside it.

import * as THREE from 'three';
import { clone } from 'three/examples/jsm/utils/SkeletonUtils.js';
import { SplatFileType, SplatMesh, SplatSkinning } from '@sparkjsdev/spark';
import { ROW, compose, inverse } from './rigid.js';
import { parseModel } from './room.js';

export class Animal {
  constructor(group) {
    this.group = group;
    group.traverse((node) => {
      if (node.isSkinnedMesh) this.mesh = node;
    });
    this.mesh.frustumCulled = false;
    this.mesh.material = new THREE.MeshLambertMaterial({ vertexColors: true });
    this.bones = this.mesh.skeleton.bones;
    this.root = this.bones[0].parent;
    this.shadow = contactShadow();
  }

  static async parse(bytes) {
    return new Animal((await parseModel(bytes)).scene);
  }

  // A translucent copy that shares the surface.
  ghost(color, opacity) {
    const copy = new Animal(clone(this.group));
    copy.mesh.material = new THREE.MeshBasicMaterial({
      color,
      transparent: true,
      opacity,
      depthWrite: false,
    });
    copy.shadow.visible = false;
    return copy;
  }

  // Gaussians in place of the surface. rows: 32 bytes each, at rest; skin: four joints and four weights a
  // Gaussian, bytes; rest: the bones' rows at rest. The skin follows dual quaternions, as the reconstruction
  // does.
  async addSplats(rows, skin, rest, scene) {
    const splats = new SplatMesh({ fileBytes: rows, fileType: SplatFileType.SPLAT });
    await splats.initialized;
    const skinning = new SplatSkinning({ mesh: splats, numBones: rest.length });
    const [zero, still] = [new THREE.Vector3(), new THREE.Quaternion()];
    rest.forEach((_, bone) => skinning.setRestQuatPos(bone, still, zero));
    for (let i = 0; i < skin.length / 8; i++) {
      const [joints, weights] = [skin.subarray(8 * i, 8 * i + 4), skin.subarray(8 * i + 4, 8 * i + 8)];
      skinning.setSplatBones(
        i,
        new THREE.Vector4(...joints),
        new THREE.Vector4(...weights).divideScalar(255),
      );
    }
    splats.skinning = skinning;
    scene.add(splats);
    this.mesh.visible = false;
    Object.assign(this, { splats, skinning, motions: rest.map(inverse) });
  }

  poseSplats(frame) {
    const [place, turn] = [new THREE.Vector3(), new THREE.Quaternion()];
    this.motions.forEach((boneFromAgent, bone) => {
      const row = compose(Array.from(frame.subarray((bone + 1) * ROW, (bone + 2) * ROW)), boneFromAgent);
      const sign = row[3] < 0 ? -1 : 1;
      this.skinning.setBoneQuatPos(
        bone,
        turn.set(sign * row[4], sign * row[5], sign * row[6], sign * row[3]),
        place.set(row[0], row[1], row[2]),
      );
    });
    this.skinning.updateBones();
    setRow(this.splats, frame, 0);
    this.splats.needsUpdate = true;
  }

  // A rim of light that shows through everything, shared surface and pose.
  outline(color) {
    const copy = new Animal(clone(this.group));
    copy.mesh.material = rim(color);
    copy.mesh.renderOrder = 9;
    copy.shadow.visible = false;
    return copy;
  }

  addTo(scene) {
    scene.add(this.group, this.shadow);
    return this;
  }

  set visible(value) {
    this.group.visible = value;
    if (!value) this.shadow.visible = false;
  }

  get visible() {
    return this.group.visible;
  }

  // Whether all of it is drawn, with its shadow.
  set shown(value) {
    this.group.visible = this.shadow.visible = value;
    if (this.splats) this.splats.visible = value;
  }

  // Take the pose of a frame: the root's row, then one row per bone; ground: the height of what carries it.
  pose(frame, ground) {
    setRow(this.root, frame, 0);
    this.bones.forEach((bone, index) => setRow(bone, frame, (index + 1) * ROW));
    if (this.splats) this.poseSplats(frame);
    const height = Math.max(0, frame[1] - ground);
    this.shadow.position.set(frame[0], ground + 0.012, frame[2]);
    this.shadow.scale.setScalar(1 + height);
    this.shadow.material.opacity = 0.42 / (1 + 6 * Math.max(0, height - 0.2));
  }
}

function setRow(node, frame, at) {
  node.position.set(frame[at], frame[at + 1], frame[at + 2]);
  node.quaternion.set(frame[at + 4], frame[at + 5], frame[at + 6], frame[at + 3]);
}

function rim(color) {
  const material = new THREE.MeshBasicMaterial({
    color,
    transparent: true,
    depthTest: false,
    depthWrite: false,
  });
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace('#include <common>', '#include <common>\nvarying vec3 rimNormal, rimEye;')
      .replace(
        '#include <project_vertex>',
        `#include <project_vertex>
        vec3 rimObject = normal;
        #ifdef USE_SKINNING
        mat4 rimSkin = skinWeight.x * getBoneMatrix(skinIndex.x) + skinWeight.y * getBoneMatrix(skinIndex.y)
          + skinWeight.z * getBoneMatrix(skinIndex.z) + skinWeight.w * getBoneMatrix(skinIndex.w);
        rimSkin = bindMatrixInverse * rimSkin * bindMatrix;
        rimObject = (rimSkin * vec4(normal, 0.0)).xyz;
        #endif
        rimNormal = normalMatrix * rimObject;
        rimEye = -mvPosition.xyz;`,
      );
    shader.fragmentShader = shader.fragmentShader
      .replace('#include <common>', '#include <common>\nvarying vec3 rimNormal, rimEye;')
      .replace(
        '#include <opaque_fragment>',
        `#include <opaque_fragment>
        float rimFacing = abs(dot(normalize(rimNormal), normalize(rimEye)));
        gl_FragColor.a = 0.12 + 0.88 * smoothstep(0.35, 0.75, 1.0 - rimFacing);`,
      );
  };
  return material;
}

function contactShadow() {
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = 64;
  const pen = canvas.getContext('2d');
  const fade = pen.createRadialGradient(32, 32, 0, 32, 32, 32);
  fade.addColorStop(0, 'rgba(30,22,14,1)');
  fade.addColorStop(0.5, 'rgba(30,22,14,.45)');
  fade.addColorStop(1, 'rgba(30,22,14,0)');
  pen.fillStyle = fade;
  pen.fillRect(0, 0, 64, 64);
  const material = new THREE.MeshBasicMaterial({
    map: new THREE.CanvasTexture(canvas),
    transparent: true,
    depthWrite: false,
  });
  const shadow = new THREE.Mesh(new THREE.PlaneGeometry(0.62, 0.62).rotateX(-Math.PI / 2), material);
  shadow.renderOrder = 1;
  return shadow;
}
