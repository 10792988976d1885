// Curves whose values stand under the pointer, or under a mark that the arrow keys move (drawn by uPlot).

const SERIES = [['loss'], ['psnr_2d', 'psnr_3d'], ['gaussians']];
const NAMES = { loss: 'Loss', psnr_2d: 'PSNR of held-out views [dB]', psnr_3d: 'PSNR of the volume [dB]', gaussians: 'Gaussians' };
const LINES = { light: ['#1557a8', '#b3470b', '#1c7245', '#7a3b9c'], dark: ['#8ab8f5', '#ffa366', '#6fd08c', '#d6a5f0'] };

function lineChart(root, label, x, lines, { height = 170, log = false, bars = false, gaps = false } = {}) {
  const dark = document.documentElement.dataset.theme === 'dark';
  const ink = colourOf('--soft');
  const grid = { stroke: colourOf('--line'), width: 1 };
  const number = (v) => (v === null || v === undefined ? '–' : shown(v, Math.abs(v) >= 1000 ? 1 : 0));
  const axis = { stroke: ink, grid, ticks: grid, font: '12px system-ui, sans-serif' };
  const decades = (_, splits) => splits.map((v) => (Number.isInteger(Math.log10(v)) ? v : null));
  const powers = {
    filter: decades,
    grid: { ...grid, filter: decades },
    ticks: { ...grid, filter: decades },
    values: (_, splits) => splits.map((v) => v?.toLocaleString('en', { notation: 'compact' }) ?? ''),
  };
  const width = Math.max(240, root.clientWidth);
  const options = {
    width,
    height,
    cursor: { drag: { x: false, y: false } },
    scales: { x: { time: false, ...(bars ? { range: (_, a, b) => [a - 0.6, b + 0.6] } : {}) }, y: log ? { distr: 3 } : bars ? { range: (_, a, b) => [Math.min(0, a), b * 1.05] } : {} },
    axes: [{ ...axis, label, labelFont: '12px system-ui, sans-serif', labelSize: 20, size: 30 }, { ...axis, size: 74, ...(log ? powers : {}) }],
    series: [
      { label, value: (_, v) => number(v) },
      ...lines.map((l, i) => ({
        label: l.name,
        stroke: l.colour || LINES[dark ? 'dark' : 'light'][i % 4],
        width: 2,
        spanGaps: !gaps,
        points: { show: x.length < 40 && !bars, size: 6 },
        ...(bars ? { paths: uPlot.paths.bars({ size: [0.7, 40] }), fill: `${l.colour || LINES[dark ? 'dark' : 'light'][i % 4]}99` } : {}),
        value: (_, v) => number(v),
      })),
    ],
  };
  const values = [x, ...lines.map((l) => l.values)];
  const kind = JSON.stringify(options);
  if (root.kind === kind) root.plot.setData(values);
  else {
    root.plot?.destroy();
    Object.assign(root, { tabIndex: 0, kind, plot: new uPlot(options, values, root) });
  }
  const { plot } = root;
  root.setAttribute('role', 'application');
  root.setAttribute('aria-roledescription', 'chart');
  root.setAttribute('aria-label', `${lines.map((l) => l.name).join(', ')} against ${label}; arrow keys read the values`);
  root.onkeydown = (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const next = Math.min(x.length - 1, Math.max(0, (root.mark ?? (by > 0 ? -1 : x.length)) + by));
    root.mark = next;
    plot.setCursor({ left: plot.valToPos(x[next], 'x'), top: 10 });
  };
}

class Curves {
  constructor(root, history) {
    Object.assign(this, { root, history, against: 'iteration' });
    const bar = element('div', { class: 'bar' });
    const pick = choice('Against', ['iterations', 'seconds'], 0, (i) => {
      this.against = ['iteration', 'seconds'][i];
      pick.choose(i);
      this.paint();
    });
    bar.append(pick);
    this.charts = element('div');
    this.table = element('details');
    this.table.append(text('summary', 'As a table'));
    this.table.addEventListener('toggle', () => this.fillTable());
    this.root.replaceChildren(bar, this.charts, this.table);
    this.paint();
    let width = 0;
    new ResizeObserver(() => {
      if (this.charts.clientWidth === width) return;
      width = this.charts.clientWidth;
      this.paint();
    }).observe(this.charts);
  }

  replace(history) {
    this.history = history;
    this.paint();
  }

  paint() {
    const entries = this.history.filter((h) => Number.isFinite(h[this.against]));
    const x = entries.map((h) => h[this.against]);
    const label = this.against === 'seconds' ? 'seconds' : 'iteration';
    const known = (key) => entries.some((h) => Number.isFinite(h[key]));
    const rows = SERIES.map((keys) => keys.filter(known)).filter((keys) => keys.length);
    while (this.charts.children.length < rows.length) this.charts.append(element('div', { class: 'chart' }));
    rows.forEach((keys, i) => {
      const lines = keys.map((key) => ({ name: NAMES[key], values: entries.map((h) => h[key] ?? null) }));
      const values = lines[0].values.filter((v) => v !== null);
      const log = keys[0] === 'loss' && Math.min(...values) > 0 && Math.max(...values) > 10 * Math.min(...values);
      lineChart(this.charts.children[i], label, x, lines, { log });
    });
    this.entries = entries;
    this.columns = ['iteration', 'seconds', ...rows.flat()];
    this.fillTable();
  }

  // Rows only while they can be seen: those of a long fit are many.
  fillTable() {
    if (!this.table.open) return;
    const { entries, columns } = this;
    const made = element('table');
    const head = element('tr');
    head.append(...columns.map((c) => text('th', NAMES[c] || c, { scope: 'col' })));
    made.append(head);
    for (const entry of entries) {
      const row = element('tr');
      row.append(...columns.map((c) => text('td', c in entry ? shown(entry[c], c === 'iteration' || c === 'gaussians' ? 1 : 0) : '–')));
      made.append(row);
    }
    this.table.replaceChildren(this.table.firstChild, made);
  }
}
