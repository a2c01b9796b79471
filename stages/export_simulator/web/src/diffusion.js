// Denoising: DDPM and DDIM over a linear schedule, and classifier-free guidance. Counterpart of
// pipeline/behavior/diffusion.py.

export function visited(schedule, count) {
  const last = schedule.steps - 1;
  if (count === 1) return [last];
  return Array.from({ length: count }, (_, i) => Math.floor(last - (last * i) / (count - 1) + 0.5));
}

// e = e_without + scale (e_with - e_without); one call where the scale is 0 or 1.
export function guided(withCondition, without, scale) {
  if (scale === 1) return withCondition;
  if (scale === 0) return without;
  return async (x, t) => {
    const reference = await without(x, t);
    const full = await withCondition(x, t);
    return reference.map((value, i) => value + scale * (full[i] - value));
  };
}

// denoise(x, t) predicts the noise in x; draw(count) gives fresh noise, for DDPM alone; correct(clean) is
// applied to the clean estimates of the steps at which most of the variance is clean.
export async function sample(denoise, noise, schedule, { method, count, draw, correct }) {
  const steps = visited(schedule, count);
  let x = Float32Array.from(noise);
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
    x = x.map(
      (value, i) =>
        signal * clean[i] +
        drift * (value - Math.sqrt(now) * estimate[i]) +
        (fresh ? Math.sqrt(variance) * fresh[i] : 0),
    );
  }
  return x;
}

const clamp = (value, bound) => Math.min(bound, Math.max(-bound, value));
