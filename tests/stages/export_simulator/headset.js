// A headset for a page in a browser that has none: two eyes beside each other on the page's canvas, a hand
// with a stick and a trigger. `headset.place` is where the head is on the floor of the play space.
(() => {
  const POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const LENS = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1.002, -1, 0, 0, -0.1002, 0];
  const at = (x, y, z) => {
    const matrix = Float32Array.from(POSE);
    matrix.set([x, y, z], 12);
    return { matrix, inverse: { matrix }, position: { x, y, z }, orientation: { x: 0, y: 0, z: 0, w: 1 } };
  };
  const headset = (window.headset = { place: [0.4, 1.2, 0.3], down: 0.8, sessions: 0, asked: [] });

  class Session extends EventTarget {
    environmentBlendMode = 'opaque';
    visibilityState = 'visible';
    enabledFeatures = ['local-floor'];
    renderState = {};
    hand = {
      handedness: 'left',
      targetRayMode: 'tracked-pointer',
      targetRaySpace: 'ray',
      gripSpace: null,
      hand: null,
      profiles: [],
      gamepad: { axes: [0, 0, 0, 0], buttons: [] },
    };
    inputSources = [this.hand];
    updateRenderState(state) {
      Object.assign(this.renderState, state);
    }
    async requestReferenceSpace(kind) {
      if (headset.refuses) throw new Error('no floor');
      headset.asked.push(kind);
      queueMicrotask(() => {
        const event = new Event('inputsourceschange');
        this.dispatchEvent(Object.assign(event, { added: [this.hand], removed: [] }));
      });
      return { kind };
    }
    requestAnimationFrame(draw) {
      return requestAnimationFrame((time) => !this.ended && draw(time, this.frame()));
    }
    cancelAnimationFrame(id) {
      cancelAnimationFrame(id);
    }
    frame() {
      const [x, y, z] = headset.place;
      const views = [-0.03, 0.03].map((side, i) => ({
        eye: i ? 'right' : 'left',
        projectionMatrix: Float32Array.from(LENS),
        transform: at(x + side, y, z),
      }));
      return { session: this, getViewerPose: () => ({ views, transform: at(x, y, z) }), getPose: this.pose };
    }
    // the hand points down and ahead
    pose() {
      const [x, y, z] = headset.place;
      const [sine, cosine] = [Math.sin(-headset.down), Math.cos(-headset.down)];
      const matrix = [1, 0, 0, 0, 0, cosine, sine, 0, 0, -sine, cosine, 0, x, y - 0.2, z, 1];
      return { transform: { matrix: Float32Array.from(matrix) } };
    }
    pull() {
      this.dispatchEvent(Object.assign(new Event('select'), { inputSource: this.hand, frame: this.frame() }));
    }
    async end() {
      this.ended = true;
      this.dispatchEvent(new Event('end'));
    }
  }
  window.XRWebGLBinding = undefined;
  window.XRWebGLLayer = class {
    framebuffer = null;
    constructor(session, gl) {
      Object.assign(this, {
        framebufferWidth: gl.drawingBufferWidth,
        framebufferHeight: gl.drawingBufferHeight,
      });
    }
    getViewport({ eye }) {
      const width = this.framebufferWidth / 2;
      return { x: eye === 'left' ? 0 : width, y: 0, width, height: this.framebufferHeight };
    }
  };
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  Object.defineProperty(navigator, 'xr', {
    value: {
      isSessionSupported: async (mode) => mode === 'immersive-vr',
      requestSession: async () => {
        headset.sessions += 1;
        headset.session = new Session();
        return headset.session;
      },
    },
  });
})();
