// Hands on the scene: keys walk the observer and turn the view, a drag on the figure carries it, a click on
// floor or furniture is a goal, one more with the pins (or with shift), a stroke with the pen (or with shift)
// is a path; with the tool for it, a drag moves furniture. Keys that mean something to the part of the panel that has the focus stay its own.

const KEYS = {
  w: [0, 1],
  arrowup: [0, 1],
  s: [0, -1],
  arrowdown: [0, -1],
  a: [-1, 0],
  arrowleft: [-1, 0],
  d: [1, 0],
  arrowright: [1, 0],
};
const TURNS = { q: [-1, 0], e: [1, 0], '+': [0, -1], '=': [0, -1], '-': [0, 1] };
const TOOLS = { p: 'pen', g: 'pins', m: 'move' };
const CLICK_PX = 6;
const STROKE_M = 0.03;

export class Controls {
  constructor(room, observer, on) {
    Object.assign(this, {
      room,
      observer,
      on,
      down: new Map(),
      press: null,
      dragging: false,
      tool: null,
      stroke: null,
      lifted: null, // the height above the floor at which furniture is held
    });
    addEventListener('keydown', (event) => this.key(event));
    addEventListener('keyup', (event) => this.down.delete(event.code));
    addEventListener('blur', () => this.down.clear());
    const canvas = room.canvas;
    canvas.addEventListener('pointerdown', (event) => this.start(event), { capture: true });
    canvas.addEventListener('pointermove', (event) => this.move(event));
    canvas.addEventListener('pointerup', (event) => this.end(event));
    canvas.addEventListener('pointercancel', (event) => this.end(event));
  }

  direction() {
    return this.held(KEYS);
  }

  // How the view is to turn (about the animal) and to close in, -1..1 each.
  turning() {
    return this.held(TURNS);
  }

  // The sum of what the keys that are down mean.
  held(meanings) {
    return [...this.down.values()].reduce(
      ([x, y], key) => [x + (meanings[key]?.[0] ?? 0), y + (meanings[key]?.[1] ?? 0)],
      [0, 0],
    );
  }

  key(event) {
    // some systems report no keyup for a chord's keys
    if (event.ctrlKey || event.metaKey || event.altKey) return this.down.clear();
    const key = event.key.toLowerCase();
    if (belongs(key, event.target)) return;
    if (this.on.carries() && key.startsWith('arrow')) {
      this.on.nudge(KEYS[key]);
      event.preventDefault();
    } else if (key in KEYS || key in TURNS) {
      this.down.set(event.code, key);
      event.preventDefault();
    } else if (key === ' ') {
      if (!event.repeat) this.on.play();
      event.preventDefault();
    } else if (event.repeat) {
      // what follows happens once, however long a key is held
    } else if (key === 'r') this.on.reset();
    else if (key === 'h' || key === '?') this.on.how();
    else if (key === 'c') this.on.call();
    else if (key === 'l') this.on.announce();
    else if (key === 'n') this.on.next();
    else if (key in TOOLS) this.on.hold(TOOLS[key]);
    else if (key === 'z') this.on.undo();
    else if (key === 'enter' && this.tool === 'move') this.on.take();
    else if (key === 'escape' && this.tool) this.on.hold(null);
  }

  overObserver(event) {
    return (
      this.observer.figure.visible &&
      this.room.aim(event).intersectObject(this.observer.figure, true).length > 0
    );
  }

  start(event) {
    if (!event.isPrimary) return this.cancel();
    this.press = { x: event.clientX, y: event.clientY, moved: false };
    if (event.button !== 0) return;
    if (this.tool === 'move') return this.grasp(event);
    if (this.tool === 'pen' || event.shiftKey) this.stroke = [];
    else if (this.tool !== 'pins' && this.overObserver(event)) this.dragging = true;
    else return;
    this.room.orbit.enabled = false;
    this.room.canvas.setPointerCapture(event.pointerId);
    this.draw(event);
  }

  // A press on furniture takes it up; elsewhere it moves the view, and a click says why nothing is taken up.
  grasp(event) {
    const surface = this.room.surfacePoint(event);
    this.press.refusal = surface ? this.on.pick(surface) : 'This is outside of the room.';
    if (this.press.refusal) return;
    this.lifted = surface.up;
    this.room.orbit.enabled = false;
    this.room.canvas.setPointerCapture(event.pointerId);
  }

  // Let go of what the pointer does: a second finger means that the view is to be moved.
  cancel() {
    if (this.lifted !== null) this.on.release(false);
    if (this.stroke) this.on.stroke(null);
    Object.assign(this, { press: null, dragging: false, stroke: null, lifted: null });
    this.room.orbit.enabled = true;
  }

  draw(event) {
    const point = this.stroke && this.room.floorPoint(event);
    if (!point) return;
    const last = this.stroke.at(-1);
    if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > STROKE_M) this.stroke.push(point);
    this.on.stroke(this.stroke);
  }

  move(event) {
    if (!event.isPrimary) return;
    if (this.press && Math.hypot(event.clientX - this.press.x, event.clientY - this.press.y) > CLICK_PX)
      this.press.moved = true;
    if (this.stroke) this.draw(event);
    else if (this.lifted !== null) {
      const point = this.room.levelPoint(event, this.lifted);
      if (point) this.on.drag(point);
    } else if (this.dragging) {
      const point = this.room.floorPoint(event);
      if (point) this.on.carry(point);
    } else if (!this.press) {
      const over = this.overObserver(event);
      this.room.canvas.classList.toggle('over-observer', over);
      this.room.canvas.classList.toggle('over-floor', !over && Boolean(this.room.floorPoint(event)));
    }
  }

  end(event) {
    const { stroke, press, dragging, lifted, tool } = this;
    if (lifted !== null && event.type === 'pointerup') {
      this.lifted = null;
      this.on.release(true);
    }
    this.cancel();
    if (event.type !== 'pointerup' || lifted !== null) return;
    const click = press && !press.moved && !dragging && event.button === 0;
    if (stroke && !(click && event.shiftKey)) this.on.drawn(stroke);
    else if (click && tool === 'move') this.on.refuse(press.refusal);
    else if (click) {
      const surface = this.room.surfacePoint(event);
      if (surface) this.on.aim(surface, event.shiftKey || this.tool === 'pins');
    }
  }
}

// Whether a key means something to the element that has the focus.
function belongs(key, element) {
  if (element.matches?.('[type=range]')) return key.startsWith('arrow') || '+=-'.includes(key);
  if (element.matches?.('button')) return key === ' ' || key === 'enter';
  if (element.matches?.('[type=checkbox]')) return key === ' ';
  return Boolean(element.matches?.('input, select'));
}
