// Denoising: DDPM and DPM-Solver++ over a schedule, and classifier-free guidance. Counterpart of
// pipeline/behavior/diffusion.py.

// Half the logarithm of the signal-to-noise ratio of a step.
const logSnr = (schedule, t) => Math.log(schedule.alpha_bar[t] / (1 - schedule.alpha_bar[t])) / 2;

export function visited(schedule, count, method) {
  const last = schedule.steps - 1;
  const evenly = (from, to) =>
    Array.from({ length: count }, (_, i) => (count === 1 ? from : from + ((to - from) * i) / (count - 1)));
  if (method !== 'dpm_solver') return evenly(last, 0).map((t) => Math.floor(t + 0.5));
  const ratios = Array.from({ length: schedule.steps }, (_, t) => logSnr(schedule, t));
  const nearest = (wanted) =>
    ratios.reduce((best, it, t) => (Math.abs(it - wanted) < Math.abs(ratios[best] - wanted) ? t : best), 0);
  return [...new Set(evenly(ratios[last], ratios[0]).map(nearest))];
}

// What weights the noise predicted with everybody, without the observer, and without that and each companion, so
// that each has a scale of its own: e = e_left + observer (e_full - e_left) + sum of (scale - 1) (e_left - e_k).
export function guidanceWeights([observer, ...companions]) {
  const more = companions.reduce((sum, scale) => sum + scale - 1, 0);
  return [observer, 1 + more - observer, ...companions.map((scale) => 1 - scale)];
}

// The weighted sum of what denoisers predict, of weights that add up to 1; those of weight 0 are not called.
export function guided(denoisers, weights) {
  const called = denoisers.map((denoise, i) => [weights[i] ?? 0, denoise]).filter(([weight]) => weight);
  const [, last] = called.pop();
  return async (x, t) => {
    const reference = await last(x, t);
    const sum = Float32Array.from(reference);
    for (const [weight, denoise] of called) {
      const noise = await denoise(x, t);
      noise.forEach((value, i) => (sum[i] += weight * (value - reference[i])));
    }
    return sum;
  };
}

// denoise(x, t) predicts the noise in x; draw(count) gives fresh noise, for DDPM alone; correct(clean) is
// applied to the clean estimates of the steps at which most of the variance is clean.
export async function sample(denoise, noise, schedule, { method, count, draw, correct }) {
  const steps = visited(schedule, count, method);
  const strides = steps.slice(1).map((t, i) => logSnr(schedule, t) - logSnr(schedule, steps[i]));
  let [x, earlier] = [Float32Array.from(noise), null];
  for (const [position, t] of steps.entries()) {
    const now = schedule.alpha_bar[t];
    const epsilon = await denoise(x, t);
    const estimate = x.map((value, i) =>
      clamp((value - Math.sqrt(1 - now) * epsilon[i]) / Math.sqrt(now), schedule.clip),
    );
    const clean = correct && now > 0.5 ? correct(estimate) : estimate;
    if (position === steps.length - 1) return clean;
    const later = schedule.alpha_bar[steps[position + 1]];
    const variance = method === 'ddpm' ? ((1 - later) / (1 - now)) * (1 - now / later) : 0;
    const [signal, drift] = [Math.sqrt(later), Math.sqrt(Math.max(1 - later - variance, 0) / (1 - now))];
    const fresh = method === 'ddpm' ? draw(x.length) : null;
    const share =
      method === 'dpm_solver' && earlier && position < steps.length - 2
        ? strides[position] / strides[position - 1] / 2
        : 0;
    const ahead = (i) => (share ? share * (clean[i] - earlier[i]) : 0);
    x = x.map(
      (value, i) =>
        signal * (clean[i] + ahead(i)) +
        drift * (value - Math.sqrt(now) * (estimate[i] + ahead(i))) +
        (fresh ? Math.sqrt(variance) * fresh[i] : 0),
    );
    earlier = clean;
  }
  return x;
}

const clamp = (value, bound) => Math.min(bound, Math.max(-bound, value));
