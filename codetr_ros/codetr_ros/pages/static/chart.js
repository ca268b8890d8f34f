// A chart of one or more curves over steps, for mouse and keys. uPlot draws it.
import { colour, make, number } from './page.js';

const COLOURS = ['#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9', '#8c6d31',
  '#7f7f7f', '#b5179e', '#3a86ff', '#6a994e', '#bc4749'];

/** The value at the cursor or, where there is none, the last. */
function shown(plot, value, series, index) {
  const values = plot.data[series];
  return number(index === null ? values[values.length - 1] : value);
}

/**
 * Curves that share their steps. `label` names the chart for people who do not see it. The arrow
 * keys move the cursor from step to step, Home and End to the first and the last.
 */
export class Chart {
  constructor(element, label, { xLabel = 'environment steps', height = 220 } = {}) {
    this.element = element;
    this.label = label;
    this.xLabel = xLabel;
    this.height = height;
    this.names = '';
    this.plot = null;
    element.classList.add('chart');
    element.tabIndex = 0;
    element.setAttribute('role', 'group');
    element.addEventListener('keydown', (event) => this.move(event));
    this.empty = make('p', { className: 'empty', text: 'Nothing yet.' });
    element.append(this.empty);
    new ResizeObserver(() => this.fit()).observe(element);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.rebuild());
  }

  /**
   * Show curves: for each a name, its steps, and its values (null where there is none). Those with
   * `right` have an axis of their own.
   */
  show(curves) {
    const known = curves.filter(({ steps }) => steps.length);
    this.empty.hidden = known.length > 0;
    const last = known.map(({ name, values }) => `${name} ${number(values[values.length - 1])}`);
    this.element.setAttribute(
      'aria-label',
      `${this.label}: ${last.length ? `at the end ${last.join(', ')}` : 'nothing yet'}. ` +
        'Left and right move through the steps.',
    );
    this.data = known.length
      ? uPlot.join(known.map(({ steps, values }) => [steps, values]))
      : [[]];
    const names = JSON.stringify(known.map(({ name }) => name));
    if (this.plot && names === this.names) {
      this.plot.setData(this.data);
    } else {
      this.names = names;
      this.curves = known;
      this.rebuild();
    }
  }

  rebuild() {
    if (this.plot) this.plot.destroy();
    this.plot = null;
    if (!this.curves || !this.curves.length) return;
    const axis = {
      stroke: colour('text'),
      grid: { stroke: colour('line'), width: 1 },
      ticks: { stroke: colour('line'), width: 1 },
    };
    const ticked = { ...axis, size: 62, values: (plot, ticks) => ticks.map(number) };
    const right = this.curves.some((curve) => curve.right);
    const options = {
      width: this.width(),
      height: this.height,
      scales: { x: { time: false } },
      axes: [{ ...axis, label: this.xLabel, labelSize: 20, size: 34 },
        ticked, ...(right ? [{ ...ticked, scale: 'right', side: 1, grid: { show: false } }] : [])],
      series: [
        { label: this.xLabel, value: shown },
        ...this.curves.map((curve, i) => ({
          label: curve.name,
          scale: curve.right ? 'right' : 'y',
          stroke: COLOURS[i % COLOURS.length],
          width: 1.5,
          spanGaps: true,
          points: { show: curve.points ? true : undefined },
          value: shown,
        })),
      ],
    };
    this.plot = new uPlot(options, this.data, this.element);
  }

  width() {
    return Math.max(200, this.element.clientWidth);
  }

  fit() {
    if (this.plot && this.plot.width !== this.width()) {
      this.plot.setSize({ width: this.width(), height: this.height });
    }
  }

  move(event) {
    const moves = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity };
    const steps = this.plot ? this.plot.data[0] : [];
    if (!(event.key in moves) || !steps.length) return;
    event.preventDefault();
    const now = this.plot.cursor.idx ?? (moves[event.key] > 0 ? -1 : steps.length);
    const index = Math.min(steps.length - 1, Math.max(0, now + moves[event.key]));
    this.point(steps[index]);
  }

  /** Move the cursor to a step. */
  point(step) {
    if (this.plot) this.plot.setCursor({ left: this.plot.valToPos(step, 'x'), top: 10 });
  }
}
