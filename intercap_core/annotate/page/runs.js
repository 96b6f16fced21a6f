/* Runs of consecutive frames. */

/* Runs in a list of frames: [first, last]. */
export function runs(frames) {
  const runs = [];
  for (const t of [...frames].sort((a, b) => a - b)) {
    if (runs.length && runs.at(-1)[1] === t - 1) runs.at(-1)[1] = t;
    else runs.push([t, t]);
  }
  return runs;
}

/* Runs of set elements of a mask by frame: [first, first after it]. */
export const intervals = (mask) => runs([...mask.keys()].filter((t) => mask[t])).map(([first, last]) => [first, last + 1]);
