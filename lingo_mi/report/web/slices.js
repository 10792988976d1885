// Linked slices of volumes on one grid: crosshair, window and level, zoom, one / side by side / curtain.

const PLANES = { 2: ['Axial', 0, 1], 1: ['Coronal', 0, 2], 0: ['Sagittal', 1, 2] }; // name, axis to the right, axis up
const AXES = ['x', 'y', 'z'];
const CROSSHAIR = ['#ff9d5c', '#6fd08c', '#79b8ff'];

class Slices {
  constructor(root, known, arrays, maps) {
    Object.assign(this, { root, known, maps });
    this.volumes = known.volumes.map((v) => ({ name: v.name, array: arrays[v.array] }));
    this.errorMaps = (known.maps || []).map((m) => ({ name: m.name, array: arrays[m.array] }));
    this.layers = this.listLayers();
    this.at = [...known.start];
    this.window = [...known.window];
    this.centre = [...known.centre];
    this.zoom = 1;
    this.mode = 0;
    this.layer = 0;
    this.other = Math.min(1, this.layers.length - 1);
    this.curtain = 0.5;
    this.tool = 'cross'; // what a drag with the left button draws
    this.marks = {}; // the line and the region that were drawn: axis of the slice, and two places in mm
    this.draw = onceAFrame(() => this.paint());
    this.build();
    new ResizeObserver(this.draw).observe(this.grid);
  }

  // New volumes on the same grid; a window that was changed stays.
  replace(known, arrays) {
    this.volumes = known.volumes.map((v) => ({ name: v.name, array: arrays[v.array] }));
    if (this.window.every((edge, i) => edge === this.known.window[i])) this.window = [...known.window];
    this.known = known;
    this.colours = null;
    const [low, high] = this.range();
    for (const one of [this.levelSlider, this.widthSlider]) {
      const input = one.querySelector('input');
      Object.assign(input, one === this.levelSlider ? { min: low, max: high } : { max: high - low });
      input.step = (high - low) / 500;
    }
    this.probe.forget();
    this.draw();
  }

  listLayers() {
    const out = this.volumes.map((v, i) => ({ name: v.name, kind: 'density', of: i }));
    const { reference } = this.known;
    const compared = this.volumes.map((_, i) => i).filter((i) => i !== reference);
    const pairs = reference === null ? compared.slice(1).map((i) => [i, compared[0]]) : compared.map((i) => [i, reference]);
    for (const kind of ['difference', 'error']) {
      for (const [of, to] of pairs) {
        const plain = pairs.length === 1 ? '' : `: ${this.volumes[of].name} − ${this.volumes[to].name}`;
        out.push({ name: (kind === 'difference' ? 'Difference' : 'Error') + plain, kind, of, to });
      }
    }
    this.errorMaps.forEach((m, of) => out.push({ name: m.name, kind: 'map', of }));
    return out;
  }

  build() {
    const { known } = this;
    const bar = element('div', { class: 'bar' });
    this.layerChoice = choice('Show', this.layers.map((l, i) => `${i + 1} ${l.name}`), 0, (i) => this.show(i));
    bar.append(this.layerChoice);
    if (this.layers.length > 1) {
      this.modeChoice = choice('as', ['One', 'Side by side', 'Curtain'], 0, (i) => this.arrange(i));
      this.otherPick = element('select', { 'aria-label': 'behind the curtain' });
      this.layers.forEach((l, i) => this.otherPick.append(text('option', l.name, { value: i })));
      this.otherPick.value = this.other;
      this.otherPick.addEventListener('change', () => {
        this.other = Number(this.otherPick.value);
        this.draw();
      });
      this.curtainSlider = slider('Curtain', 0, 1, 0.01, 0.5, (v) => this.drawCurtain(v));
      this.curtainBox = element('span', { class: 'group' });
      this.curtainBox.append(text('span', 'over'), this.otherPick, this.curtainSlider);
      bar.append(this.modeChoice, this.curtainBox);
    }
    const [low, high] = this.range();
    const step = (high - low) / 500;
    this.levelSlider = slider('Level', low, high, step, 0, (v) => this.level(v, this.window[1] - this.window[0]));
    this.widthSlider = slider('Window', step, high - low, step, 0, (v) => this.level((this.window[0] + this.window[1]) / 2, v));
    bar.append(this.levelSlider, this.widthSlider);
    this.grid = element('div', { class: 'grid' });
    const places = element('div', { class: 'bar', style: 'margin: .8rem 0 0' });
    this.placeSliders = known.shape.map((n, axis) => {
      const one = slider(AXES[axis], 0, n - 1, 1, 0, (v) => this.move(axis, v));
      if (n > 1) places.append(one);
      return one;
    });
    places.append(button('Show all', false, () => this.reset()));
    places.lastChild.removeAttribute('aria-pressed');
    this.scales = element('div', { class: 'scales' });
    this.readout = this.buildReadout();
    const scroll = element('div', { class: 'scroll' });
    scroll.append(this.readout);
    const step0 = this.volumes[0].array.step;
    const preview = known.preview > 1 ? ` A preview: each voxel here is the mean of ${known.preview}³ of the volume's.` : '';
    const compared = this.layers.some((l) => l.kind === 'difference') ? ' Difference: red is too dense, blue too thin.' : '';
    const mapped = this.errorMaps.length ? ' Error map: bright where the volume is least certain; it ranks voxels, and is not the size of their errors.' : '';
    this.note = text('p', `Axes are the scanner's, in mm; z is the axis of rotation. Values are stored in steps of ${step0.toExponential(1)}.${compared}${mapped}${preview}`, { class: 'note' });
    this.probe = new Probe(this);
    this.root.replaceChildren(bar, this.grid, places, this.scales, scroll, this.note, this.probe.root);
    this.arrange(0);
  }

  buildReadout() {
    const made = element('table', { class: 'readout' });
    const head = element('tr');
    const names = ['', 'x [mm]', 'y [mm]', 'z [mm]', 'voxel', ...this.layers.filter((l) => l.kind !== 'error').map((l) => l.name)];
    head.append(...names.map((n) => text('th', n, { scope: 'col' })));
    const top = element('thead');
    top.append(head);
    const body = element('tbody');
    this.rows = ['Crosshair', 'Pointer'].map((name) => {
      const row = element('tr', { 'data-row': name.toLowerCase() });
      row.append(text('th', name, { scope: 'row' }), ...names.slice(1).map((n) => text('td', '–', { 'data-name': n })));
      body.append(row);
      return row;
    });
    this.rows[0].setAttribute('aria-live', 'polite');
    made.append(text('caption', this.known.quantity, { style: 'text-align: left; color: var(--soft)' }), top, body);
    return made;
  }

  range() {
    let low = Infinity;
    let high = -Infinity;
    for (const { array } of this.volumes) {
      let least = 65535;
      let most = 0;
      for (const code of array.codes) {
        if (code < least) least = code;
        if (code > most) most = code;
      }
      low = Math.min(low, array.low + array.step * least);
      high = Math.max(high, array.low + array.step * most);
    }
    return [Math.min(0, low), high > low ? high : low + 1e-6];
  }

  // ---- what is shown ----

  show(layer) {
    if (layer >= this.layers.length) return;
    this.layer = layer;
    this.layerChoice.choose(layer);
    if (this.mode === 1) this.arrange(0);
    this.draw();
  }

  arrange(mode) {
    this.mode = mode;
    if (this.modeChoice) this.modeChoice.choose(mode);
    if (this.curtainBox) this.curtainBox.hidden = mode !== 2;
    if (mode === 2 && this.other === this.layer) {
      this.other = (this.layer + 1) % this.layers.length;
      this.otherPick.value = this.other;
    }
    const focused = document.activeElement && document.activeElement.dataset.axis;
    const axes = this.known.axes;
    const size = (axis) => this.known.shape[axis] * this.known.spacing[axis];
    this.grid.style.gridTemplateColumns = axes.map((a) => `minmax(0, ${size(PLANES[a][1])}fr)`).join(' ');
    this.grid.style.maxWidth = axes.length === 1 ? '44rem' : '';
    this.grid.replaceChildren();
    this.panels = [];
    const rows = mode === 1 ? this.layers.map((_, i) => i) : [null];
    for (const layer of rows) {
      if (layer !== null) this.grid.append(text('div', this.layers[layer].name, { class: 'row-name' }));
      for (const axis of axes) this.grid.append(this.panel(axis, layer));
    }
    if (focused !== undefined) this.grid.querySelector(`[data-axis="${focused}"]`)?.focus({ preventScroll: true });
    this.draw();
  }

  panel(axis, layer) {
    const [name, across, up] = PLANES[axis];
    const figure = element('figure');
    const caption = text('figcaption', '');
    const canvas = element('canvas', { class: 'picture', tabindex: 0, role: 'application', 'data-axis': axis, 'aria-roledescription': 'slice' });
    const { shape, spacing } = this.known;
    canvas.style.aspectRatio = `${shape[across] * spacing[across]} / ${shape[up] * spacing[up]}`;
    figure.append(...(layer === null || layer === 0 ? [caption] : []), canvas);
    const panel = { axis, across, up, name, canvas, caption, layer, image: null };
    this.listen(panel);
    this.panels.push(panel);
    return figure;
  }

  move(axis, index) {
    const bounded = Math.min(this.known.shape[axis] - 1, Math.max(0, Math.round(index)));
    if (bounded === this.at[axis]) return;
    this.at[axis] = bounded;
    if (this.moved) this.moved(this.millimetres(this.at));
    this.draw();
  }

  level(level, width) {
    this.window = [level - width / 2, level + width / 2];
    this.colours = null;
    this.draw();
  }

  drawCurtain(share) {
    this.curtain = Math.min(1, Math.max(0, share));
    this.draw();
  }

  reset() {
    this.zoom = 1;
    this.centre = [...this.known.centre];
    this.window = [...this.known.window];
    this.colours = null;
    this.draw();
  }

  zoomAt(factor, place, axes) {
    const next = Math.min(32, Math.max(1, this.zoom * factor));
    const real = next / this.zoom;
    for (const axis of axes) this.centre[axis] = place[axis] + (this.centre[axis] - place[axis]) / real;
    this.zoom = next;
    this.bound();
    this.draw();
  }

  bound() {
    const { shape, spacing, centre } = this.known;
    for (let axis = 0; axis < 3; axis++) {
      const free = (shape[axis] * spacing[axis] * (1 - 1 / this.zoom)) / 2;
      this.centre[axis] = Math.min(centre[axis] + free, Math.max(centre[axis] - free, this.centre[axis]));
    }
  }

  millimetres(voxel) {
    const { shape, spacing, centre } = this.known;
    return voxel.map((i, axis) => centre[axis] + (i + 0.5 - shape[axis] / 2) * spacing[axis]);
  }

  voxelAt(place) {
    const { shape, spacing, centre } = this.known;
    return place.map((x, a) => Math.floor((x - centre[a]) / spacing[a] + shape[a] / 2));
  }

  // A mark of the tool across the middle half of the slice, from which it can be drawn or moved.
  startMark() {
    const { shape, spacing, centre, axes } = this.known;
    const axis = Number(document.activeElement?.dataset.axis ?? axes[0]);
    const [, across, up] = PLANES[axis];
    const quarter = [across, up].map((a) => (shape[a] * spacing[a]) / 4);
    const ends = [-1, 1].map((sign) => centre.map((x, a) => x + sign * (a === across ? quarter[0] : a === up && this.tool === 'region' ? quarter[1] : 0)));
    this.marks[this.tool] = { axis, from: ends[0], to: ends[1] };
  }

  // The first or the second end of a line or a region, at the crosshair.
  markEnd(axis, end) {
    if (this.tool === 'cross') return;
    const place = this.millimetres(this.at);
    const mark = this.marks[this.tool];
    this.marks[this.tool] = mark?.axis === axis ? { ...mark, [end]: place } : { axis, from: place, to: place };
    this.draw();
  }

  index([x, y, z]) {
    const [nx, ny] = this.known.shape;
    return x + nx * (y + ny * z);
  }

  value(layer, index) {
    const { kind, of, to } = this.layers[layer];
    if (kind === 'map') return valueAt(this.errorMaps[of].array, index);
    const value = valueAt(this.volumes[of].array, index);
    if (kind === 'density') return value;
    const difference = value - valueAt(this.volumes[to].array, index);
    return kind === 'error' ? Math.abs(difference) : difference;
  }

  // ---- pointer and keys ----

  listen(panel) {
    const { canvas, axis, across, up } = panel;
    const other = [across, up];
    let drag = null;
    const placed = (event) => {
      const box = canvas.getBoundingClientRect();
      const scale = this.scaleOf(panel, box.width);
      const place = [...this.millimetres(this.at)];
      place[across] = this.centre[across] + (event.clientX - box.left - box.width / 2) / scale;
      place[up] = this.centre[up] - (event.clientY - box.top - box.height / 2) / scale;
      return { place, scale };
    };
    const voxel = (place) => this.voxelAt(place).map((i, a) => (a === axis ? this.at[axis] : i));
    const inside = (v) => v.every((i, a) => i >= 0 && i < this.known.shape[a]);
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
      drag = { kind: event.button === 2 ? 'level' : event.shiftKey || event.button === 1 ? 'pan' : this.tool, x: event.clientX, y: event.clientY, window: [...this.window] };
      const { place } = placed(event);
      if (drag.kind === 'cross') other.forEach((a) => this.move(a, voxel(place)[a]));
      if (drag.kind === 'line' || drag.kind === 'region') this.marks[drag.kind] = { axis, from: place, to: place };
      event.preventDefault();
    });
    canvas.addEventListener('pointermove', (event) => {
      const { place, scale } = placed(event);
      const found = voxel(place);
      this.pointer = inside(found) ? found : null;
      if (drag) {
        const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
        if (drag.kind === 'cross') other.forEach((a) => this.move(a, found[a]));
        if (drag.kind === 'line' || drag.kind === 'region') this.marks[drag.kind] = { ...this.marks[drag.kind], to: place };
        if (drag.kind === 'pan') {
          this.centre[across] -= dx / scale;
          this.centre[up] += dy / scale;
          Object.assign(drag, { x: event.clientX, y: event.clientY });
          this.bound();
        }
        if (drag.kind === 'level') {
          const width = drag.window[1] - drag.window[0];
          const level = (drag.window[0] + drag.window[1]) / 2;
          this.level(level - (dy * width) / 200, width * 2 ** (dx / 120));
        }
      }
      this.draw();
    });
    const stop = () => { drag = null; };
    canvas.addEventListener('pointerup', stop);
    canvas.addEventListener('pointercancel', stop);
    canvas.addEventListener('pointerleave', () => {
      this.pointer = null;
      this.draw();
    });
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('dblclick', () => this.reset());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      if (event.ctrlKey) this.zoomAt(event.deltaY < 0 ? 1.15 : 1 / 1.15, placed(event).place, other);
      else this.move(axis, this.at[axis] + (event.deltaY < 0 ? 1 : -1));
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => {
      const by = event.shiftKey ? 10 : 1;
      const here = this.millimetres(this.at);
      const acts = {
        ArrowLeft: () => this.move(across, this.at[across] - by),
        ArrowRight: () => this.move(across, this.at[across] + by),
        ArrowUp: () => this.move(up, this.at[up] + by),
        ArrowDown: () => this.move(up, this.at[up] - by),
        PageUp: () => this.move(axis, this.at[axis] + by),
        PageDown: () => this.move(axis, this.at[axis] - by),
        Home: () => this.move(axis, 0),
        End: () => this.move(axis, this.known.shape[axis] - 1),
        '+': () => this.zoomAt(1.25, here, [0, 1, 2]),
        '=': () => this.zoomAt(1.25, here, [0, 1, 2]),
        '-': () => this.zoomAt(0.8, here, [0, 1, 2]),
        0: () => this.reset(),
        a: () => this.markEnd(axis, 'from'),
        b: () => this.markEnd(axis, 'to'),
      };
      if (event.ctrlKey || event.metaKey || event.altKey || !acts[event.key]) return;
      event.preventDefault();
      acts[event.key]();
    });
  }

  // Of the whole page: the key that names a layer or a way to show it.
  key(name) {
    if (/^[1-9]$/.test(name)) this.show(Number(name) - 1);
    else if (this.layers.length < 2) return;
    else if ('osc'.includes(name)) this.arrange('osc'.indexOf(name));
    else if (name === '[') this.drawCurtain(this.curtain - 0.05);
    else if (name === ']') this.drawCurtain(this.curtain + 0.05);
  }

  // ---- drawing ----

  scaleOf(panel, width) {
    return (width / (this.known.shape[panel.across] * this.known.spacing[panel.across])) * this.zoom;
  }

  prepareColours() {
    if (this.colours) return;
    const { array } = this.volumes[0];
    const width = this.window[1] - this.window[0];
    this.largest = width / 4;
    this.colours = {
      density: pixelsOfCodes(this.maps.grey, array, ...this.window),
      difference: pixelsOfDifferences(this.maps.difference, array.step, this.largest, false),
      error: pixelsOfDifferences(this.maps.error, array.step, this.largest, true),
    };
    this.scales.replaceChildren(scaleBar(this.maps.grey, this.known.quantity, ...this.window));
    if (this.layers.some((l) => l.kind === 'difference')) {
      this.scales.append(
        scaleBar(this.maps.difference, 'difference', -this.largest, this.largest),
        scaleBar(this.maps.error, 'error', 0, this.largest),
      );
    }
    if (this.errorMaps.length) {
      // One scale for all maps, each with codes of its own.
      const top = Math.max(...this.errorMaps.map(({ array }) => array.low + array.step * array.codes.reduce((a, b) => Math.max(a, b), 0)));
      this.colours.map = this.errorMaps.map(({ array }) => pixelsOfCodes(this.maps.error, array, 0, top));
      this.scales.append(scaleBar(this.maps.error, 'error map', 0, top));
    }
  }

  // A slice of a layer as a small canvas of one pixel a voxel, top row first.
  slice(panel, layer) {
    const { shape } = this.known;
    const strides = [1, shape[0], shape[0] * shape[1]];
    const [columns, rows] = [shape[panel.across], shape[panel.up]];
    const [right, upward] = [strides[panel.across], strides[panel.up]];
    const first = strides[panel.axis] * this.at[panel.axis];
    if (!panel.small) panel.small = element('canvas', { width: columns, height: rows });
    const pen = panel.small.getContext('2d');
    if (!panel.image) panel.image = pen.createImageData(columns, rows);
    const pixels = new Uint32Array(panel.image.data.buffer);
    const { kind, of, to } = this.layers[layer];
    const colours = kind === 'map' ? this.colours.map[of] : this.colours[kind];
    const a = (kind === 'map' ? this.errorMaps : this.volumes)[of].array.codes;
    const b = to === undefined ? null : this.volumes[to].array.codes;
    let k = 0;
    for (let row = rows - 1; row >= 0; row--) {
      let i = first + row * upward;
      if (b) for (let c = 0; c < columns; c++, i += right) pixels[k++] = colours[a[i] - b[i] + 65535];
      else for (let c = 0; c < columns; c++, i += right) pixels[k++] = colours[a[i]];
    }
    pen.putImageData(panel.image, 0, 0);
    return panel.small;
  }

  paint() {
    this.prepareColours();
    for (const panel of this.panels) this.paintPanel(panel);
    const here = this.millimetres(this.at);
    for (const panel of this.panels) {
      const place = `${AXES[panel.axis]} = ${here[panel.axis].toFixed(1)} mm`;
      panel.caption.textContent = `${panel.name}, ${place}`;
      const layer = this.layers[panel.layer ?? this.layer];
      const value = shown(this.value(panel.layer ?? this.layer, this.index(this.at)), this.volumes[0].array.step);
      panel.canvas.setAttribute('aria-label', `${panel.name} slice, ${layer.name}, ${place}, ${value} at the crosshair`);
    }
    this.placeSliders.forEach((s, axis) => s.set(this.at[axis], `${here[axis].toFixed(1)} mm`));
    const [low, high] = this.window;
    this.levelSlider.set((low + high) / 2, shown((low + high) / 2, (high - low) / 100));
    this.widthSlider.set(high - low, shown(high - low, (high - low) / 100));
    if (this.curtainSlider) this.curtainSlider.set(this.curtain, `${Math.round(this.curtain * 100)} %`);
    this.fillReadout(this.rows[0], this.at);
    this.fillReadout(this.rows[1], this.pointer);
    this.probe.paint();
  }

  fillReadout(row, voxel) {
    const cells = [...row.querySelectorAll('td')];
    if (!voxel) return cells.forEach((c) => { c.textContent = '–'; });
    const { step } = this.volumes[0].array;
    const said = [
      ...this.millimetres(voxel).map((x) => x.toFixed(1)),
      voxel.join(', '),
      ...this.layers.flatMap((l, i) => (l.kind === 'error' ? [] : [shown(this.value(i, this.index(voxel)), step)])),
    ];
    cells.forEach((cell, i) => { if (cell.textContent !== said[i]) cell.textContent = said[i]; });
  }

  paintPanel(panel) {
    const { canvas, across, up } = panel;
    const ratio = fit(canvas);
    const pen = canvas.getContext('2d');
    const { width, height } = canvas;
    const { shape, spacing, centre } = this.known;
    const scale = this.scaleOf(panel, width);
    const x = (mm) => width / 2 + (mm - this.centre[across]) * scale;
    const y = (mm) => height / 2 - (mm - this.centre[up]) * scale;
    const half = [across, up].map((a) => (shape[a] * spacing[a]) / 2);
    const box = [x(centre[across] - half[0]), y(centre[up] + half[1]), 2 * half[0] * scale, 2 * half[1] * scale];
    pen.fillStyle = colourOf('--stage');
    pen.fillRect(0, 0, width, height);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(this.slice(panel, panel.layer ?? this.layer), ...box);
    if (this.mode === 2) {
      const edge = Math.round(width * this.curtain);
      pen.save();
      pen.beginPath();
      pen.rect(edge, 0, width - edge, height);
      pen.clip();
      pen.drawImage(this.slice(panel, this.other), ...box);
      pen.restore();
      pen.fillStyle = '#ffd54a';
      pen.fillRect(edge - ratio, 0, 2 * ratio, height);
    }
    const here = this.millimetres(this.at);
    pen.lineWidth = ratio;
    const gap = 9 * ratio;
    const [cx, cy] = [x(here[across]), y(here[up])];
    const line = (colour, ...points) => {
      pen.strokeStyle = colour;
      pen.beginPath();
      for (let i = 0; i < points.length; i += 4) {
        pen.moveTo(points[i], points[i + 1]);
        pen.lineTo(points[i + 2], points[i + 3]);
      }
      pen.stroke();
    };
    line(CROSSHAIR[across], cx, 0, cx, cy - gap, cx, cy + gap, cx, height);
    line(CROSSHAIR[up], 0, cy, cx - gap, cy, cx + gap, cy, width, cy);
    this.paintMarks(pen, panel, ratio, x, y);
    this.paintLabels(pen, panel, ratio, scale);
  }

  paintMarks(pen, { axis, across, up }, ratio, x, y) {
    for (const [kind, mark] of Object.entries(this.marks)) {
      if (mark.axis !== axis) continue;
      const [ax, ay, bx, by] = [x(mark.from[across]), y(mark.from[up]), x(mark.to[across]), y(mark.to[up])];
      for (const [colour, width] of [['rgba(0, 0, 0, .8)', 4], ['#ffd54a', 2]]) {
        pen.strokeStyle = colour;
        pen.lineWidth = width * ratio;
        pen.beginPath();
        if (kind === 'region') pen.rect(Math.min(ax, bx), Math.min(ay, by), Math.abs(bx - ax), Math.abs(by - ay));
        else {
          pen.moveTo(ax, ay);
          pen.lineTo(bx, by);
        }
        pen.stroke();
      }
    }
  }

  paintLabels(pen, panel, ratio, scale) {
    const { width, height } = pen.canvas;
    pen.font = `${13 * ratio}px system-ui, sans-serif`;
    const label = (said, px, py, align) => {
      pen.textAlign = align;
      pen.lineWidth = 3 * ratio;
      pen.strokeStyle = 'rgba(0, 0, 0, .8)';
      pen.strokeText(said, px, py);
      pen.fillStyle = '#ffffff';
      pen.fillText(said, px, py);
    };
    label(`${AXES[panel.across]} →`, width - 6 * ratio, height - 8 * ratio, 'right');
    label(`↑ ${AXES[panel.up]}`, 6 * ratio, 17 * ratio, 'left');
    const goal = (width / scale) * 0.22;
    const power = 10 ** Math.floor(Math.log10(goal));
    const length = [5, 2, 1].map((f) => f * power).find((l) => l <= goal);
    label(`${Number(length.toPrecision(2))} mm`, 8 * ratio, height - 14 * ratio, 'left');
    pen.fillStyle = '#000000';
    pen.fillRect(7 * ratio, height - 9 * ratio, length * scale + 2 * ratio, 4 * ratio);
    pen.fillStyle = '#ffffff';
    pen.fillRect(8 * ratio, height - 8 * ratio, length * scale, 2 * ratio);
    if (this.mode === 2) {
      label(this.layers[panel.layer ?? this.layer].name, width * this.curtain - 6 * ratio, height - 30 * ratio, 'right');
      label(this.layers[this.other].name, width * this.curtain + 6 * ratio, height - 30 * ratio, 'left');
    }
  }
}
