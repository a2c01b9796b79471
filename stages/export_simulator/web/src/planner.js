// The main thread's side of the planner: starts the worker, which plans for all animals, and sends it requests.

import * as assets from './assets.js';

const MODELS = ['perception', 'goal', 'path', 'body'];

export class Planner {
  // residents: {contract, prefix of its assets, allowed} each.
  static async open(residents, onProgress) {
    const planner = new Planner();
    const source = document.getElementById('asset-worker');
    const code = new Blob([await assets.bytes('worker')], { type: 'text/javascript' });
    source.remove();
    planner.worker = new Worker(URL.createObjectURL(code));
    planner.asked = new Map();
    planner.next = 0;
    planner.worker.onmessage = ({ data }) => planner.answered(data, onProgress);
    planner.worker.onerror = (event) => planner.broke(new Error(event.message));
    const wasm = await assets.bytes('ort.wasm');
    onProgress(0.3);
    for (const [index, { contract, prefix, allowed }] of residents.entries()) {
      const models = Object.fromEntries(
        await Promise.all(MODELS.map(async (name) => [name, await assets.bytes(prefix + name)])),
      );
      const volume = await assets.bytes(`${prefix}volume`);
      const first = index ? {} : { wasm };
      planner.loaded = index / residents.length;
      planner.share = 1 / residents.length;
      await planner.ask('load', { contract, models, volume, allowed, ...first }, [
        ...(index ? [] : [wasm.buffer]),
        volume.buffer,
        ...Object.values(models).map((model) => model.buffer),
      ]);
    }
    return planner;
  }

  ask(kind, content, transfer = []) {
    const id = this.next++;
    if (this.failure) return Promise.reject(this.failure);
    return new Promise((done, fail) => {
      this.asked.set(id, { done, fail });
      this.worker.postMessage({ id, kind, content }, transfer);
    });
  }

  broke(error) {
    this.failure = error;
    for (const { fail } of this.asked.values()) fail(error);
    this.asked.clear();
  }

  answered({ id, share, result, error }, onProgress) {
    if (share !== undefined) return onProgress(0.3 + 0.7 * (this.loaded + this.share * share));
    const { done, fail } = this.asked.get(id);
    this.asked.delete(id);
    return error ? fail(new Error(error)) : done(result);
  }

  plan(question) {
    return this.ask('plan', question);
  }

  goals(question) {
    return this.ask('goals', question);
  }

  furnish(furniture) {
    return this.ask('furnish', furniture);
  }

  golden(golden, animal) {
    return this.ask('golden', { golden, animal });
  }
}
