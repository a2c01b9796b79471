// Hands on the scene: keys walk the observer, a drag on the figure carries it, a click on the floor is a goal.

const KEYS = { w: [0, 1], arrowup: [0, 1], s: [0, -1], arrowdown: [0, -1], a: [-1, 0], arrowleft: [-1, 0], d: [1, 0], arrowright: [1, 0] };
const CLICK_PX = 6;

export class Controls {
  constructor(room, observer, on) {
    Object.assign(this, { room, observer, on, down: new Set(), press: null, dragging: false });
    addEventListener('keydown', (event) => this.key(event, true));
    addEventListener('keyup', (event) => this.key(event, false));
    addEventListener('blur', () => this.down.clear());
    const canvas = room.canvas;
    canvas.addEventListener('pointerdown', (event) => this.start(event), { capture: true });
    canvas.addEventListener('pointermove', (event) => this.move(event));
    canvas.addEventListener('pointerup', (event) => this.end(event));
    canvas.addEventListener('pointercancel', (event) => this.end(event));
  }

  direction() {
    return [...this.down].reduce(([x, y], key) => [x + KEYS[key][0], y + KEYS[key][1]], [0, 0]);
  }

  key(event, pressed) {
    if (event.target.matches?.('input, select') || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    if (key in KEYS) {
      this.down[pressed ? 'add' : 'delete'](key);
      event.preventDefault();
    } else if (pressed && key === ' ' && !event.target.matches?.('button')) {
      this.on.play();
      event.preventDefault();
    } else if (pressed && key === 'r') this.on.reset();
  }

  overObserver(event) {
    return this.room.aim(event).intersectObject(this.observer.figure, true).length > 0;
  }

  start(event) {
    this.press = { x: event.clientX, y: event.clientY, moved: false };
    if (event.button === 0 && this.overObserver(event)) {
      this.dragging = true;
      this.room.orbit.enabled = false;
      this.room.canvas.setPointerCapture(event.pointerId);
    }
  }

  move(event) {
    if (this.press && Math.hypot(event.clientX - this.press.x, event.clientY - this.press.y) > CLICK_PX) this.press.moved = true;
    if (this.dragging) {
      const point = this.room.floorPoint(event);
      if (point) this.observer.target = point;
    } else if (!this.press) {
      const over = this.overObserver(event);
      this.room.canvas.classList.toggle('over-observer', over);
      this.room.canvas.classList.toggle('over-floor', !over && Boolean(this.room.floorPoint(event)));
    }
  }

  end(event) {
    const clicked = this.press && !this.press.moved && !this.dragging && event.type === 'pointerup' && event.button === 0;
    this.press = null;
    this.dragging = false;
    this.room.orbit.enabled = true;
    if (!clicked) return;
    const point = this.room.floorPoint(event);
    if (point) this.on.aim(point);
  }
}
