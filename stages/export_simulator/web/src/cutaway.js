// What stands between the view and the animal is cut away: a capsule from the eye to shortly before the
// animal, never the floor. The same for the mesh (fragments are discarded), the splats (an edit) and clicks.

import * as THREE from 'three';
import { SplatEdit, SplatEditRgbaBlendMode, SplatEditSdf, SplatEditSdfType } from '@sparkjsdev/spark';

const RADIUS_M = 0.34; // shows an animal of half a meter whole
const SHORT_OF_M = 0.3; // the cut ends this far before the animal, so that what carries it stays
const ABOVE_FLOOR_M = 0.06; // lower things stay: they hide nothing
const FLAT_EDGE_M = 0.08; // splats fade out over this
const LOOK_EVERY_MS = 300; // between tests of whether anything hides the animal
// the cut moves in such steps there, so that the still is drawn again a few times a second at most
const STEP_M = 0.12;

export class Cutaway {
  constructor(floor) {
    this.floor = floor;
    this.uniforms = {
      cutFrom: { value: new THREE.Vector3() },
      cutTo: { value: new THREE.Vector3(0, 1, 0) },
      cutRadius: { value: 0 },
      cutFloor: { value: floor + ABOVE_FLOOR_M },
    };
    this.looked = -Infinity;
    this.hidden = false; // whether the room's mesh, uncut, hides the animal
  }

  // Make a material of the room's mesh leave the capsule out.
  patch(material) {
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.uniforms);
      shader.vertexShader = shader.vertexShader
        .replace('#include <common>', '#include <common>\nvarying vec3 cutPlace;')
        .replace(
          '#include <project_vertex>',
          '#include <project_vertex>\ncutPlace = (modelMatrix * vec4(transformed, 1.0)).xyz;',
        );
      shader.fragmentShader = shader.fragmentShader
        .replace(
          '#include <common>',
          `#include <common>
          varying vec3 cutPlace;
          uniform vec3 cutFrom, cutTo;
          uniform float cutRadius, cutFloor;`,
        )
        .replace(
          '#include <clipping_planes_fragment>',
          `#include <clipping_planes_fragment>
          vec3 cutAxis = cutTo - cutFrom;
          float cutShare = dot(cutPlace - cutFrom, cutAxis) / max(dot(cutAxis, cutAxis), 1e-6);
          vec3 cutNear = cutFrom + clamp(cutShare, 0.0, 1.0) * cutAxis;
          if (cutPlace.y > cutFloor && distance(cutPlace, cutNear) < cutRadius) discard;`,
        );
    };
  }

  // The same for splats.
  edit(splats) {
    this.capsule = new SplatEditSdf({ type: SplatEditSdfType.CAPSULE, opacity: 0, radius: RADIUS_M });
    const edit = new SplatEdit({
      rgbaBlendMode: SplatEditRgbaBlendMode.MULTIPLY,
      softEdge: FLAT_EDGE_M,
      sdfs: [this.capsule],
    });
    splats.add(edit, this.capsule);
  }

  // Follow eye and animal. hides: () => whether the mesh hides the animal; still: whether cutting costs a
  // redrawn still, and is done only where the animal is hidden.
  follow(eye, animal, hides, still) {
    const { cutFrom, cutTo, cutRadius } = this.uniforms;
    if (performance.now() - this.looked > LOOK_EVERY_MS) {
      this.looked = performance.now();
      this.hidden = hides();
    }
    cutRadius.value = this.hidden || !still ? RADIUS_M : 0;
    const far = eye.distanceTo(animal);
    const to = animal.clone().lerp(eye, Math.min(1, SHORT_OF_M / Math.max(far, 1e-6)));
    if (still && to.distanceTo(cutTo.value) < STEP_M && eye.distanceTo(cutFrom.value) < 1e-3) return;
    cutFrom.value.copy(eye);
    cutTo.value.copy(to);
    if (!this.capsule) return;
    this.capsule.position.lerpVectors(eye, to, 0.5);
    this.capsule.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), to.clone().sub(eye).normalize());
    this.capsule.scale.set(1, eye.distanceTo(to), 1);
  }

  // Whether a point of the room is left out.
  covers(point) {
    const {
      cutFrom: { value: from },
      cutTo: { value: to },
      cutRadius: { value: radius },
      cutFloor,
    } = this.uniforms;
    return (
      radius > 0 &&
      point.y > cutFloor.value &&
      new THREE.Line3(from, to).closestPointToPoint(point, true, new THREE.Vector3()).distanceTo(point) <
        radius
    );
  }

  // What decides how the still of the room looks.
  get key() {
    const { cutTo, cutRadius } = this.uniforms;
    return cutRadius.value ? cutTo.value.toArray() : [0];
  }

  // Draw something without the cut.
  without(draw) {
    const { cutRadius } = this.uniforms;
    const kept = cutRadius.value;
    cutRadius.value = 0;
    draw();
    cutRadius.value = kept;
  }
}
