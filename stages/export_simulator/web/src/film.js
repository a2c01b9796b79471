// A film of the view as WebM, from one press of the button to the next.

const KINDS = ['video/webm;codecs=vp9', 'video/webm;codecs=vp8', 'video/webm'];

export class Film {
  constructor(canvas) {
    this.canvas = canvas;
  }

  static get possible() {
    return (
      typeof MediaRecorder === 'function' && typeof HTMLCanvasElement.prototype.captureStream === 'function'
    );
  }

  get running() {
    return Boolean(this.recorder);
  }

  start() {
    const mimeType = KINDS.find((kind) => MediaRecorder.isTypeSupported(kind));
    this.pieces = [];
    this.recorder = new MediaRecorder(this.canvas.captureStream(30), {
      mimeType,
      videoBitsPerSecond: 6_000_000,
    });
    this.recorder.ondataavailable = ({ data }) => {
      if (data.size) this.pieces.push(data);
    };
    this.recorder.start(1000);
  }

  // The film as a blob.
  stop() {
    const { recorder } = this;
    this.recorder = null;
    return new Promise((done) => {
      recorder.onstop = () => done(new Blob(this.pieces, { type: 'video/webm' }));
      recorder.stop();
      recorder.stream.getTracks().forEach((track) => track.stop());
    });
  }
}
