// What slices measure: a profile along a line, the statistics of a region, and the histogram of the volume.

const BINS = 128;
const DENSITIES = (slices) => slices.layers.map((l, i) => ({ ...l, i })).filter((l) => l.kind === 'density');

class Probe {
  constructor(slices) {
    Object.assign(this, { slices, along: slices.known.axes.length === 1 ? PLANES[slices.known.axes[0]][1] : 0 });
    const bar = element('div', { class: 'bar', style: 'margin-top: 1.1rem' });
    const names = ['Row x', 'Column y', 'Column z', 'Drawn line'];
    this.pick = choice('Profile', names, this.along, (i) => this.profileAlong(i));
    [...this.pick.querySelectorAll('button')].forEach((b, i) => { b.hidden = i < 3 && slices.known.shape[i] === 1; });
    this.tool = choice('Drag draws', ['Crosshair', 'Line', 'Region'], 0, (i) => this.draws(i));
    bar.append(this.pick, this.tool);
    this.profile = element('div', { class: 'chart' });
    this.histogram = element('div', { class: 'chart' });
    this.note = text('p', '', { class: 'note' });
    this.caption = text('p', '', { class: 'note' });
    this.table = element('table', { class: 'readout' });
    const left = element('div');
    left.append(text('h3', 'Profile'), this.profile, this.note);
    const right = element('div');
    right.append(text('h3', 'Histogram of the volume, voxels on a logarithmic scale'), this.histogram);
    const pair = element('div', { class: 'pair' });
    pair.append(left, right);
    const scroll = element('div', { class: 'scroll' });
    scroll.append(this.table);
    this.root = element('div');
    this.root.append(bar, pair, this.caption, scroll);
    this.paint = onceAFrame(() => this.update());
    let width = 0;
    new ResizeObserver(() => {
      if (pair.clientWidth === width) return;
      width = pair.clientWidth;
      this.counts = null;
      this.paint();
    }).observe(pair);
  }

  // New volumes have another histogram.
  forget() {
    Object.assign(this, { counts: null, asked: null });
    this.paint();
  }

  profileAlong(i) {
    this.along = i;
    this.pick.choose(i);
    if (i === 3 && !this.slices.marks.line) this.draws(1);
    this.paint();
  }

  draws(i) {
    const { slices } = this;
    slices.tool = ['cross', 'line', 'region'][i];
    this.tool.choose(i);
    if (i && !slices.marks[slices.tool]) slices.startMark(); // so that there is something to see, and to move by keys
    if (i === 1) this.profileAlong(3);
    slices.draw();
  }

  update() {
    this.paintProfile();
    this.paintRegion();
    if (!this.counts) this.paintHistogram();
  }

  // Ends of the profile, in mm.
  ends() {
    const { slices, along } = this;
    const { shape, spacing, centre } = slices.known;
    if (along === 3) {
      const { line } = slices.marks;
      if (!line) return null;
      const here = slices.millimetres(slices.at);
      return [line.from, line.to].map((end) => end.map((x, a) => (a === line.axis ? here[a] : x)));
    }
    const here = slices.millimetres(slices.at);
    const half = ((shape[along] - 1) * spacing[along]) / 2;
    return [-half, half].map((by) => here.map((x, a) => (a === along ? centre[a] + by : x)));
  }

  paintProfile() {
    const ends = this.ends();
    if (!ends) return;
    const { slices } = this;
    const { shape, spacing } = slices.known;
    const [from, to] = ends;
    const length = Math.hypot(...to.map((x, a) => x - from[a]));
    const step = Math.min(...spacing.filter((_, a) => shape[a] > 1));
    const count = this.along < 3 ? shape[this.along] : Math.max(2, Math.min(1024, Math.round(length / step) + 1));
    const places = Array.from({ length: count }, (_, i) => (count === 1 ? 0 : i / (count - 1)));
    const x = places.map((t) => (this.along < 3 ? from[this.along] + t * (to[this.along] - from[this.along]) : t * length));
    const lines = DENSITIES(slices).map((l) => ({
      name: l.name,
      values: places.map((t) => {
        const voxel = slices.voxelAt(from.map((f, a) => f + t * (to[a] - f)));
        return voxel.every((v, a) => v >= 0 && v < shape[a]) ? slices.value(l.i, slices.index(voxel)) : null;
      }),
    }));
    lineChart(this.profile, `${this.along < 3 ? AXES[this.along] : 'along the line'} [mm]`, x, lines, { height: 200 });
    const written = (p) => p.map((v) => v.toFixed(1)).join(', ');
    this.note.textContent = `${slices.known.quantity}, from (${written(from)}) to (${written(to)}) mm, ${length.toFixed(1)} mm: the values of the voxels there, without interpolation.`;
  }

  paintRegion() {
    const { slices } = this;
    const { region } = slices.marks;
    if (!region) return;
    const { shape, spacing } = slices.known;
    const [low, high] = [0, 1].map((end) => slices.at.map((i, a) => {
      if (a === region.axis) return i;
      const both = [region.from, region.to].map((p) => slices.voxelAt(p)[a]);
      return Math.min(shape[a] - 1, Math.max(0, end ? Math.max(...both) : Math.min(...both)));
    }));
    const asked = `${low} ${high}`;
    if (asked === this.asked) return;
    this.asked = asked;
    const sides = [0, 1, 2].filter((a) => a !== region.axis);
    const size = sides.map((a) => high[a] - low[a] + 1);
    const layers = slices.layers.map((l, i) => ({ ...l, i })).filter((l) => l.kind === 'density' || l.kind === 'difference');
    const { step } = slices.volumes[0].array;
    const rows = layers.map((l) => {
      let [sum, squares, least, most, n] = [0, 0, Infinity, -Infinity, 0];
      for (let z = low[2]; z <= high[2]; z++) for (let y = low[1]; y <= high[1]; y++) for (let x = low[0]; x <= high[0]; x++) {
        const value = slices.value(l.i, slices.index([x, y, z]));
        sum += value;
        squares += value * value;
        least = Math.min(least, value);
        most = Math.max(most, value);
        n += 1;
      }
      const mean = sum / n;
      return [l.name, mean, Math.sqrt(Math.max(0, squares / n - mean * mean)), least, most].map((v) => (typeof v === 'string' ? v : shown(v, step)));
    });
    const top = element('tr');
    top.append(...['Region', 'mean', 'std', 'min', 'max'].map((n) => text('th', n, { scope: 'col' })));
    const made = rows.map(([name, ...values]) => {
      const row = element('tr', { 'data-layer': name });
      row.append(text('th', name, { scope: 'row' }), ...values.map((v) => text('td', v)));
      return row;
    });
    const [name] = PLANES[region.axis];
    const mm = sides.map((a, k) => (size[k] * spacing[a]).toFixed(1)).join(' × ');
    this.caption.textContent = `Region of the ${name.toLowerCase()} slice: ${mm} mm, ${size.join(' × ')} voxels; ${slices.known.quantity}`;
    this.table.replaceChildren(top, ...made);
  }

  paintHistogram() {
    const { slices } = this;
    const [low, high] = slices.range();
    const width = (high - low) / BINS;
    const lines = DENSITIES(slices).map((l) => {
      const { array } = slices.volumes[l.of];
      const bins = new Float64Array(BINS);
      const scale = array.step / width;
      const first = (array.low - low) / width;
      for (const code of array.codes) bins[Math.min(BINS - 1, Math.max(0, Math.floor(first + scale * code)))] += 1;
      return { name: l.name, values: Array.from(bins, (n) => n || null) };
    });
    this.counts = lines;
    const x = Array.from({ length: BINS }, (_, i) => low + (i + 0.5) * width);
    lineChart(this.histogram, slices.known.quantity, x, lines, { height: 200, log: true, gaps: true });
  }
}
