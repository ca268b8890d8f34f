// The page on which a person scores segments: by clicks and by keys.
import { Chart } from './chart.js';
import { at, follow, make, number, send, write } from './page.js';

const KEYS = '= same as before, x can\'t tell, s later, c compare.';
const FRAME_MS = 100;
const state = { scale: [1, 5], desk: null, later: [], shown: [], correcting: null, last: null,
  stated: [], comparing: false, busy: false };

const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);
const isIn = (segments, one) => segments.some((each) => same(each, one));

function words([source, episode, first, length]) {
  return `${source}, episode ${episode}, steps ${first} to ${first + length - 1}`;
}

/** Shows one segment: its pictures if it can be drawn, else its curves. */
class Shown {
  constructor(element, title) {
    this.segment = null;
    this.element = element;
    this.title = make('h3', { text: title });
    this.picture = make('img', { className: 'frames', attributes: { alt: '' } });
    this.picture.hidden = true;
    this.note = make('p', {});
    const observations = make('div');
    const actions = make('div');
    element.append(this.title, this.picture, this.note, observations, actions);
    this.observations = new Chart(observations, 'what the robot saw', { xLabel: 'step', height: 160 });
    this.actions = new Chart(actions, 'what it did', { xLabel: 'step', height: 120 });
    this.timer = null;
    this.abandon = new AbortController();
  }

  async show(segment) {
    if (same(segment, this.segment)) return;
    this.segment = segment;
    clearInterval(this.timer);
    this.picture.hidden = true;
    write(this.note, '');
    // pictures take seconds: those of a segment that nobody looks at any more are not drawn
    this.abandon.abort();
    this.abandon = new AbortController();
    try {
      await this.fetch(segment, this.abandon.signal);
    } catch (error) {
      if (!same(segment, this.segment)) return;
      this.segment = null; // it is asked for again
      throw error;
    }
  }

  async fetch(segment, signal) {
    const curves = await send('/segment', { segment }, signal);
    if (!same(segment, this.segment)) return;
    const curve = (name) => (values, i) => ({
      name: `${name} ${i + 1}`,
      steps: values.map((_, t) => curves.first + t * curves.every),
      values,
    });
    this.observations.show(curves.observations.map(curve('observation')));
    this.actions.show(curves.actions.map(curve('action')));
    if (!curves.drawn) return;
    const { frames, note } = await send('/segment', { segment, frames: true }, signal);
    if (!same(segment, this.segment)) return;
    write(this.note, note);
    if (!frames.length) return;
    let at = 0;
    this.picture.alt = `the robot, ${words(segment)}`;
    this.picture.hidden = false;
    const next = () => { this.picture.src = frames[at++ % frames.length]; };
    next();
    if (!matchMedia('(prefers-reduced-motion: reduce)').matches) {
      this.timer = setInterval(next, FRAME_MS);
    }
  }
}

const one = new Shown(at('one'), 'The segment');
const two = new Shown(at('two'), 'The second');

/** The points of the scale, and the key of each: the point itself or, where it has no key, its place. */
function points() {
  const [lowest, highest] = state.scale;
  const all = Array.from({ length: Math.max(0, highest - lowest + 1) }, (_, i) => lowest + i);
  const own = lowest >= 0 && highest <= 9;
  return all.map((point, i) => ({ point, key: String(own ? point : i + 1), own }));
}

function keysOfPoints() {
  const all = points();
  if (!all.length) return '';
  return all[0].own ? 'the points themselves, ' : `1 to ${all.length} for the points in their order, `;
}

/** The segments to judge now: one, or two to be compared. */
function due() {
  if (state.correcting) return state.correcting;
  // the desk that knows of the last statement may still be on its way
  const waiting = (state.desk ? state.desk.waiting : []).filter((each) => !isIn(state.stated, each));
  const now = waiting.filter((each) => !isIn(state.later, each));
  const rest = [...now, ...waiting.filter((each) => !now.includes(each))];
  return rest.slice(0, state.comparing ? 2 : 1);
}

function judged(segment) {
  return state.desk.given.some((given) => same(given.segment, segment) || same(given.other, segment));
}

function render() {
  const { desk } = state;
  if (!desk) return;
  write(at('title'), `${desk.task}: score segments as ${desk.scorer}`);
  const phase = desk.phase < 0 ? 'no phase is done yet' : `phase ${desk.phase + 1} of ${desk.phases} is done`;
  write(at('state'), desk.finished ? 'The run has ended: nothing more is learnt.' : `The run goes on without you; ${phase}.`);
  // what somebody looks at stays, though the run asks for others by now: else a click would be for
  // another segment than the one that was looked at
  const kept = state.shown.length && (state.correcting || !state.shown.some(judged));
  const wanted = state.correcting ? state.correcting.length : 1 + state.comparing;
  if (!kept || state.shown.length !== wanted) state.shown = due();
  const comparing = state.shown.length === 2;
  const none = !state.shown.length || desk.finished || Boolean(desk.problem);
  at('answers').hidden = none || comparing;
  at('choices').hidden = none || !comparing;
  at('two').hidden = !comparing;
  at('one').hidden = none;
  at('pair').disabled = desk.waiting.length < 2;
  at('same').disabled = state.last === null;
  const what = state.correcting ? 'Corrected: ' : '';
  write(at('which'), none ? 'Nothing waits to be scored.' :
    `${what}${state.shown.map(words).join(' | ')}. ${desk.waiting.length} wait. ${comparing ? '' : `Keys: ${keysOfPoints()}${KEYS}`}`);
  if (!none) one.show(state.shown[0]).catch(refuse);
  if (comparing) two.show(state.shown[1]).catch(refuse);
  renderProblems(desk);
  renderGiven();
}

function renderProblems(desk) {
  at('problem').hidden = !desk.problem;
  write(at('problem'), desk.problem ? `Nothing that you state is taken: ${desk.problem}` : '');
  at('passed').hidden = !desk.passed_over;
  write(at('passed'), desk.passed_over
    ? `${desk.passed_over} of your statements were taken by none of the phases since. The run refuses them, or they were lost: the log of its recorder (logs/record.log) names the reason.`
    : '');
}

function stated(given) {
  if (given.other) {
    if (given.outcome === null) return 'cannot tell';
    return { 1: 'the first is better', 0.5: 'as good', 0: 'the second is better' }[given.outcome];
  }
  return given.value === null ? 'cannot tell' : number(given.value);
}

function renderGiven() {
  const rows = [...state.desk.given].reverse().map((given) => {
    const correct = make('button', { text: 'Correct' });
    correct.addEventListener('click', () => {
      state.correcting = given.other ? [given.segment, given.other] : [given.segment];
      state.shown = [];
      render();
    });
    const cells = [
      make('td', { text: words(given.segment) + (given.other ? ` | ${words(given.other)}` : '') }),
      make('td', { text: stated(given) }),
      make('td', { text: given.phase === null ? 'waits' : `phase ${given.phase}` }),
      make('td', { children: [correct] }),
    ];
    return make('tr', { children: cells });
  });
  at('given').replaceChildren(...rows);
}

const waits = (segment) => isIn([...state.desk.waiting, ...(state.correcting ?? [])], segment);

function refuse(error) {
  write(at('refused'), error.message);
  // what is not asked for any more may not be held any more either: then nobody can judge it
  if (!state.shown.every(waits)) state.shown = [];
}

async function judge(statement) {
  if (state.busy || at('answers').hidden && at('choices').hidden) return;
  state.busy = true;
  const begin = performance.now();
  write(at('refused'), '');
  try {
    const given = await send('/judge', statement);
    if (!given.other && given.value !== null) state.last = given.value;
    const took = performance.now() - begin;
    write(at('confirmed'), `Number ${given.sequence}: ${stated(given)} for ${words(given.segment)}. The next commit takes it.`);
    at('confirmed').dataset.ms = String(took);
    state.correcting = null;
    state.shown = [];
    state.stated.push(given.segment, ...(given.other ? [given.other] : []));
  } catch (error) {
    refuse(error);
  } finally {
    state.busy = false;
  }
  render();
}

const score = (value) => judge({ segment: state.shown[0], value });
const prefer = (outcome) => judge({ segment: state.shown[0], other: state.shown[1], outcome });

function later() {
  state.later.push(...state.shown);
  state.correcting = null;
  state.shown = [];
  render();
}

function compare() {
  state.comparing = state.shown.length < 2 && state.desk.waiting.length > 1;
  state.correcting = null;
  state.shown = [];
  render();
}

function renderScale() {
  const any = !points().length;
  at('number').hidden = !any;
  at('points').hidden = any;
  const buttons = points().map(({ point, key, own }) => {
    const button = make('button', { text: own ? String(point) : `${point} (${key})` });
    button.addEventListener('click', () => score(point));
    return button;
  });
  at('points').replaceChildren(...buttons);
}

at('number').addEventListener('submit', (event) => {
  event.preventDefault();
  const value = at('value').valueAsNumber;
  if (Number.isFinite(value)) {
    score(value);
    at('value').value = '';
  }
});
for (const [id, act] of Object.entries({
  same: () => score(state.last),
  cannot: () => score(null),
  skip: later,
  pair: compare,
  single: compare,
  first: () => prefer(1),
  equal: () => prefer(0.5),
  second: () => prefer(0),
  neither: () => prefer(null),
})) at(id).addEventListener('click', act);

document.addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target instanceof HTMLInputElement) return;
  const comparing = state.shown.length === 2;
  const keys = comparing
    ? { a: 'first', e: 'equal', b: 'second', x: 'neither', c: 'single' }
    : { '=': 'same', x: 'cannot', s: 'skip', c: 'pair' };
  const id = keys[event.key];
  if (id) {
    at(id).click();
    event.preventDefault();
    return;
  }
  const pressed = points().find(({ key }) => key === event.key);
  if (!comparing && pressed) {
    score(pressed.point);
    event.preventDefault();
  }
});

follow(
  {
    scale: (scale) => { state.scale = scale; renderScale(); },
    desk: (desk) => {
      state.desk = desk;
      state.stated = state.stated.filter((each) => isIn(desk.waiting, each));
      render();
    },
  },
  (link) => write(at('link'), link === 'live' ? '' : 'The server does not answer.'),
);
