// Words beside what is drawn, so that nothing depends on color alone.

export class Tags {
  constructor(camera) {
    this.camera = camera;
    this.labels = {};
  }

  label(name) {
    if (this.labels[name]) return this.labels[name];
    this.labels[name] = Object.assign(document.createElement('span'), {
      className: `tag ${name}`,
      hidden: true,
    });
    document.body.append(this.labels[name]);
    return this.labels[name];
  }

  // point: a THREE.Vector3 in the world, which is overwritten; an empty text hides the word.
  put(name, text, point) {
    if (!text && !this.labels[name]) return;
    const label = this.label(name);
    label.hidden = !text;
    if (!text) return;
    if (label.textContent !== text) label.textContent = text;
    point.project(this.camera);
    label.hidden = point.z > 1 || Math.abs(point.x) > 1.1 || Math.abs(point.y) > 1.1;
    const [x, y] = [((point.x + 1) / 2) * innerWidth, ((1 - point.y) / 2) * innerHeight];
    label.style.transform = `translate(-50%, -100%) translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
  }
}
