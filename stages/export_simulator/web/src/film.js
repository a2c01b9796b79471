// A film of the view, from one press of the button to the next: WebM or, where the browser records no WebM, MP4.

const WEBM = 'video/webm';
const KINDS = [`${WEBM};codecs=vp9`, `${WEBM};codecs=vp8`, WEBM, 'video/mp4'];

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
    const pieces = [];
    this.recorder = new MediaRecorder(this.canvas.captureStream(30), {
      mimeType,
      videoBitsPerSecond: 6_000_000,
    });
    this.pieces = pieces;
    this.recorder.ondataavailable = ({ data }) => {
      if (data.size) pieces.push(data);
    };
    this.recorder.start(1000);
  }

  // The film: {blob, ending of its file's name}.
  stop() {
    const { recorder, pieces } = this;
    const [type] = (recorder.mimeType || WEBM).split(';');
    this.recorder = null;
    return new Promise((done) => {
      recorder.onstop = () => done({ blob: new Blob(pieces, { type }), ending: type.split('/')[1] });
      recorder.stop();
      recorder.stream.getTracks().forEach((track) => track.stop());
    });
  }
}
