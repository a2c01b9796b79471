// The worker: holds the networks, answers the page's questions one at a time.

import * as ort from 'onnxruntime-web/wasm';
import { Sampler } from './sampler.js';
import { Senses } from './senses.js';

const samplers = []; // one per animal
let turn = Promise.resolve();

const answers = {
  async load({ contract, wasm, models, volume, allowed }, report) {
    ort.env.wasm.numThreads = 1;
    if (wasm) ort.env.wasm.wasmBinary = wasm.buffer;
    ort.env.logLevel = 'error';
    const networks = {};
    const names = Object.keys(models);
    for (const [i, name] of names.entries()) {
      const session = await ort.InferenceSession.create(models[name], {
        executionProviders: ['wasm'],
        graphOptimizationLevel: 'all',
      });
      networks[name] = async (feeds) => {
        const tensors = Object.fromEntries(
          Object.entries(feeds).map(([key, [values, shape]]) => [
            key,
            new ort.Tensor('float32', values, shape),
          ]),
        );
        return (await session.run(tensors))[session.outputNames[0]].data;
      };
      report((i + 1) / names.length);
    }
    samplers.push(new Sampler(contract, networks, new Senses(contract, volume, allowed)));
  },
  furnish: ({ animal, ...furniture }) => samplers[animal].senses.furnish(furniture),
  async plan(question) {
    const start = performance.now();
    const plan = await samplers[question.animal].plan(question);
    return { ...plan, milliseconds: performance.now() - start };
  },
  goals: (question) => samplers[question.animal].sampleGoals(question),
  golden: ({ golden, animal }) => samplers[animal].golden(golden),
};

onmessage = ({ data: { id, kind, content } }) => {
  turn = turn.then(async () => {
    try {
      postMessage({ id, result: await answers[kind](content, (share) => postMessage({ id, share })) });
    } catch (error) {
      postMessage({ id, error: `${kind}: ${error.message ?? error}` });
    }
  });
};
