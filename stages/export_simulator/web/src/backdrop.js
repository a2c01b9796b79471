// The room as a still: drawn once per view, colors and depth, and laid beneath everything else in every
// frame. Where a processor draws, this is most of the work saved while the view rests.

import * as THREE from 'three';

// three.js draws layers 1 and 2 for the left and the right eye of a headset alone
export const BACKDROP_LAYER = 3;

export class Backdrop {
  constructor(renderer) {
    this.renderer = renderer;
    this.still = new THREE.WebGLRenderTarget(1, 1, {
      type: THREE.HalfFloatType,
      // pixel on pixel: interpolation would cost as much as all else that is drawn
      minFilter: THREE.NearestFilter,
      magFilter: THREE.NearestFilter,
      depthTexture: new THREE.DepthTexture(1, 1, THREE.UnsignedIntType),
    });
    const material = new THREE.ShaderMaterial({
      uniforms: { color: { value: this.still.texture }, depth: { value: this.still.depthTexture } },
      vertexShader:
        'varying vec2 place; void main() { place = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }',
      fragmentShader: `
        uniform sampler2D color, depth;
        varying vec2 place;
        void main() {
          gl_FragColor = texture2D(color, place);
          gl_FragDepth = texture2D(depth, place).r;
          #include <colorspace_fragment>
        }`,
      depthFunc: THREE.AlwaysDepth,
    });
    this.sheet = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
    this.sheet.frustumCulled = false;
    this.scene = new THREE.Scene().add(this.sheet);
    this.eye = new THREE.Camera();
  }

  // more: numbers that also decide how the room looks.
  render(scene, camera, more) {
    const { renderer } = this;
    this.refresh(scene, camera, more);
    camera.layers.set(0);
    renderer.render(this.scene, this.eye);
    renderer.autoClear = false;
    renderer.render(scene, camera);
    renderer.autoClear = true;
    camera.layers.enable(BACKDROP_LAYER);
  }

  refresh(scene, camera, more) {
    const size = this.renderer.getDrawingBufferSize(new THREE.Vector2());
    camera.updateMatrixWorld();
    const key = [...size, ...camera.matrixWorld.elements, ...camera.projectionMatrix.elements, ...more]
      .map((value) => value.toFixed(4))
      .join();
    if (key === this.key) return;
    this.key = key;
    this.still.setSize(size.x, size.y);
    camera.layers.set(BACKDROP_LAYER);
    this.renderer.setRenderTarget(this.still);
    this.renderer.render(scene, camera);
    this.renderer.setRenderTarget(null);
  }
}
