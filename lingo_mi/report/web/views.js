// Held-out views with a slider over their angles: rendered, measured, residual; and the residual of every view. Lines for a
// detector of one row.

class Views {
  constructor(root, known, arrays, maps) {
    Object.assign(this, { root, known, maps, at: 0 });
    this.images = known.images.map((v) => ({ name: v.name, array: arrays[v.array] }));
    this.panels = this.images.map((v, i) => ({ name: v.name, of: i }));
    const to = known.reference;
    if (to !== null) {
      const pairs = this.images.map((v, of) => ({ name: `${v.name} − ${this.images[to].name}`, of, to }));
      this.panels.push(...pairs.filter((pair) => pair.of !== to));
    }
    this.draw = onceAFrame(() => this.paint());
    this.build();
  }

  replace(known, arrays) {
    this.known = known;
    this.images = known.images.map((v) => ({ name: v.name, array: arrays[v.array] }));
    this.draw();
  }

  build() {
    const { known } = this;
    const [count, rows, columns] = known.shape;
    const bar = element('div', { class: 'bar' });
    this.slider = slider('View', 0, count - 1, 1, 0, (v) => this.move(v));
    this.slider.querySelector('input').style.width = '20rem';
    bar.append(this.slider);
    this.most = (known.window[1] - known.window[0]) / 20;
    if (known.reference !== null && rows > 1) {
      const widest = known.window[1] - known.window[0];
      this.differences = slider('Differences ±', widest / 500, widest / 2, widest / 500, this.most, (v) => {
        this.most = v;
        this.draw();
      });
      bar.append(this.differences);
    }
    this.lines = rows === 1;
    this.grid = element('div', { class: 'grid' });
    const said = ['Views that no fit has seen, as line integrals ln(I0/I); v is down, as on the panel.'];
    if (known.total > count) said.push(`${count} of ${known.total} are in this page.`);
    if (known.binning > 1) said.push(`Each pixel here is the mean of ${known.binning} × ${known.binning}.`);
    this.note = text('p', said.join(' '), { class: 'note' });
    this.byView = element('div', { class: 'chart' });
    this.psnr = element('div', { class: 'chart' });
    this.ofViews = element('div', { class: 'pair' });
    this.ofViews.append(this.psnr, this.byView);
    this.ofViews.hidden = !known.psnr && !known.residual;
    new ResizeObserver(() => this.paintByView()).observe(this.ofViews);
    if (this.lines) {
      this.chart = element('div', { class: 'chart' });
      this.root.replaceChildren(bar, this.chart, this.ofViews, this.note);
      this.draw();
      return;
    }
    this.grid.style.gridTemplateColumns = `repeat(auto-fit, minmax(min(18rem, 100%), 1fr))`;
    for (const panel of this.panels) {
      const figure = element('figure');
      const canvas = element('canvas', { class: 'picture', tabindex: 0, role: 'application', 'aria-roledescription': 'view' });
      canvas.style.aspectRatio = `${columns * known.pixel[1]} / ${rows * known.pixel[0]}`;
      figure.append(text('figcaption', panel.name), canvas);
      this.grid.append(figure);
      panel.canvas = canvas;
      this.listen(panel);
    }
    this.readout = text('p', ' ', { class: 'note', 'aria-live': 'polite' });
    this.scales = element('div', { class: 'scales' });
    this.root.replaceChildren(bar, this.grid, this.scales, this.readout, this.ofViews, this.note);
    new ResizeObserver(this.draw).observe(this.grid);
  }

  move(view) {
    this.at = Math.min(this.known.shape[0] - 1, Math.max(0, view));
    this.draw();
  }

  index(view, row, column) {
    const [, rows, columns] = this.known.shape;
    return column + columns * (row + rows * view);
  }

  value(panel, index) {
    const value = valueAt(this.images[panel.of].array, index);
    return panel.to === undefined ? value : value - valueAt(this.images[panel.to].array, index);
  }

  listen(panel) {
    const { canvas } = panel;
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.move(this.at + (event.deltaY < 0 ? 1 : -1));
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => {
      const by = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 }[event.key];
      if (!by || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      this.move(this.at + by);
    });
    canvas.addEventListener('pointermove', (event) => {
      const [, rows, columns] = this.known.shape;
      const box = canvas.getBoundingClientRect();
      const column = Math.floor(((event.clientX - box.left) / box.width) * columns);
      const row = Math.floor(((event.clientY - box.top) / box.height) * rows);
      if (row < 0 || column < 0 || row >= rows || column >= columns) return;
      const index = this.index(this.at, row, column);
      const [dv, du] = this.known.pixel;
      const values = this.panels.map((p) => `${p.name} ${shown(this.value(p, index), this.images[0].array.step)}`);
      const u = (column + 0.5 - columns / 2) * du;
      const v = (row + 0.5 - rows / 2) * dv;
      this.readout.textContent = `u = ${u.toFixed(1)} ${this.known.unit}, v = ${v.toFixed(1)} ${this.known.unit}:  ${values.join(',  ')}`;
    });
  }

  paint() {
    const { known } = this;
    this.paintByView();
    const angle = `${known.angles[this.at].toFixed(1)}°`;
    this.slider.set(this.at, `${this.at + 1} of ${known.shape[0]}, at ${angle}`);
    if (this.lines) return this.paintLines();
    this.differences?.set(this.most, shown(this.most, this.most / 100));
    const colours = {
      value: pixelsOfCodes(this.maps.grey, this.images[0].array, ...known.window),
      difference: pixelsOfDifferences(this.maps.difference, this.images[0].array.step, this.most, false),
    };
    const [, rows, columns] = known.shape;
    for (const panel of this.panels) {
      fit(panel.canvas);
      if (!panel.small) panel.small = element('canvas', { width: columns, height: rows });
      const pen = panel.small.getContext('2d');
      const image = pen.createImageData(columns, rows);
      const pixels = new Uint32Array(image.data.buffer);
      const first = this.index(this.at, 0, 0);
      const a = this.images[panel.of].array.codes;
      if (panel.to === undefined) for (let i = 0; i < pixels.length; i++) pixels[i] = colours.value[a[first + i]];
      else {
        const b = this.images[panel.to].array.codes;
        for (let i = 0; i < pixels.length; i++) pixels[i] = colours.difference[a[first + i] - b[first + i] + 65535];
      }
      pen.putImageData(image, 0, 0);
      const big = panel.canvas.getContext('2d');
      big.imageSmoothingEnabled = panel.canvas.width < columns;
      big.drawImage(panel.small, 0, 0, panel.canvas.width, panel.canvas.height);
      panel.canvas.setAttribute('aria-label', `${panel.name} view at ${angle}`);
    }
    this.scales.replaceChildren(scaleBar(this.maps.grey, 'ln(I0/I)', ...known.window));
    if (known.reference !== null) this.scales.append(scaleBar(this.maps.difference, 'difference', -this.most, this.most));
  }

  paintByView() {
    const { residual, psnr } = this.known;
    this.psnr.hidden = !psnr;
    this.byView.hidden = !residual || residual.rms.length < 3;
    if (psnr) lineChart(this.psnr, 'view, by angle', psnr.map((_, i) => i + 1), [{ name: 'PSNR of the view [dB]', values: psnr }], { bars: true });
    if (!residual || residual.rms.length < 3) return;
    lineChart(this.byView, 'angle [°]', residual.angles, [{ name: 'Residual of the view, rms', values: residual.rms }]);
  }

  paintLines() {
    const [, , columns] = this.known.shape;
    const u = Array.from({ length: columns }, (_, i) => (i + 0.5 - columns / 2) * this.known.pixel[1]);
    const series = this.images.map((v) => u.map((_, i) => valueAt(v.array, this.index(this.at, 0, i))));
    lineChart(this.chart, `u [${this.known.unit}]`, u, this.images.map((v, i) => ({ name: v.name, values: series[i] })), { height: 260 });
  }
}
