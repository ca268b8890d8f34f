// The page of a run: what the server publishes, as text, tables and charts.
import { Chart } from './chart.js';
import { at, follow, make, number, write } from './page.js';

const returns = new Chart(at('returns'), 'True return of an episode');
const scores = new Chart(at('scores'), 'Score of an episode');
const losses = new Map(); // name -> its chart
const numbers = new Chart(at('numbers'), 'A number of the run');
const rewards = new Chart(at('rewards'), 'Rewards of the steps', { xLabel: 'step' });
const observations = new Chart(at('observations'), 'Observations', { xLabel: 'step' });
const actions = new Chart(at('actions'), 'Actions', { xLabel: 'step' });

let columns = { points: {}, losses: {} };
let episode = null;
let ownUnit = false; // scores have a unit of their own, and so has what is inferred from them
let connected = false;
let ended = false;

function row(cells, tag = 'td', numeric = () => false) {
  return make('tr', {
    children: cells.map((text, i) =>
      make(tag, {
        text: String(text),
        className: numeric(i) ? 'number' : '',
        attributes: tag === 'th' ? { scope: 'col' } : {},
      })),
  });
}

function table(head, rows, caption, numeric) {
  return make('table', {
    children: [
      make('caption', { text: caption }),
      make('thead', { children: [row(head, 'th', numeric)] }),
      make('tbody', { children: rows.map((cells) => row(cells, 'td', numeric)) }),
    ],
  });
}

function showRun(run) {
  const title = `${run.task}: ${run.composite} of ${run.delay}, method ${run.method}, `
    + `seed ${run.seed}`;
  write(at('title'), title);
  document.title = `${run.task} – codetr watch`;
  write(at('folder'), run.folder);
  ownUnit = Boolean(run.own_unit);
  at('settings').replaceChildren(
    run.differences.length
      ? table(['setting', `preset ${run.preset}`, 'this run'], run.differences,
        `All other settings are those of the preset ${run.preset}.`)
      : make('p', { text: `Every setting is that of the preset ${run.preset}.` }),
  );
}

function duration(seconds) {
  const whole = Math.round(seconds);
  if (whole < 60) return `${whole} s`;
  const two = (value) => String(value).padStart(2, '0');
  if (whole < 3600) return `${Math.floor(whole / 60)}:${two(whole % 60)} min`;
  return `${Math.floor(whole / 3600)}:${two(Math.floor((whole % 3600) / 60))} h`;
}

function showStatus(status) {
  ended = ['finished', 'interrupted', 'failed'].includes(status.state);
  const words = { ending: 'ends: the report is being made' };
  let state = words[status.state] ?? status.state
    ?? 'started by hand: who takes part is not known here';
  if (status.silent) state += `, but silent for ${status.silent} s`;
  write(at('state'), state);
  at('state').className = status.state === 'failed' || status.silent ? 'bad' : '';
  at('failure').hidden = !status.failure;
  write(at('failure'), status.failure ?? '');
  at('bar').max = status.steps_planned || 1;
  at('bar').value = status.steps || 0;
  const facts = [
    ['phase', `${status.phase} of ${status.phases}`],
    ['steps', `${status.steps} of ${status.steps_planned}`],
  ];
  if (status.state === 'running' && status.steps_per_s) {
    facts.push(['speed', `${number(status.steps_per_s)} steps a second`]);
  }
  if (status.seconds_left !== null && status.seconds_left !== undefined) {
    facts.push(['left', `about ${duration(status.seconds_left)}`]);
  }
  if (status.lost !== undefined && status.lost !== null) {
    facts.push(['messages lost', String(status.lost)]);
  }
  const out = Object.entries(status.left_out ?? {});
  if (out.length) {
    const words = out.map(([name, phase]) => `${name} (since phase ${phase})`);
    facts.push(['left out', words.join(', ')]);
  }
  facts.push(['run as', status.in_process ? 'one process' : 'ROS 2 nodes']);
  if (status.namespace) facts.push(['namespace', status.namespace]);
  at('facts').replaceChildren(...facts.map(([name, text]) => make('div', {
    children: [
      make('dt', { text: name }),
      make('dd', {
        text,
        className: (name === 'messages lost' && status.lost) || name === 'left out' ? 'bad' : '',
      }),
    ],
  })));
  showNodes(status);
}

function showNodes(status) {
  const nodes = status.nodes ?? [];
  if (!nodes.length) {
    at('nodes').replaceChildren(make('p', {
      className: 'dim',
      text: 'Nobody has stated that it is there.',
    }));
    return;
  }
  const rows = nodes.map((node) => [
    node.name,
    node.role,
    node.doing || (node.finished ? 'has finished' : 'is there'),
    node.waiting ? duration(node.waiting) : '–',
    node.missed,
    node.seen ? new Date(node.seen).toLocaleTimeString() : '–',
  ]);
  const head = ['name', 'role', 'does, or waits for', 'since', 'lost', 'heard of at'];
  at('nodes').replaceChildren(table(head, rows, `${rows.length} take part`, (i) => i === 4));
}

function curve(name, column, points = false) {
  const known = columns.points[column];
  return { name, steps: known ? known[0] : [], values: known ? known[1] : [], points };
}

/** Offer these names in a select, and keep what is selected. */
function offer(select, names, preferred) {
  const before = select.value || preferred;
  const there = [...select.options].map((option) => option.value);
  if (JSON.stringify(there) !== JSON.stringify(names)) {
    select.replaceChildren(...names.map((name) => make('option', { text: name })));
    select.value = names.includes(before) ? before : names[0] ?? '';
  }
}

function showColumns(given) {
  columns = given;
  returns.show([
    curve('evaluation', 'evaluation.true_return_mean', true),
    curve('training', 'training.true_return_mean'),
  ]);
  scores.show([
    curve('evaluation', 'evaluation.score_mean', true),
    curve('training', 'training.score_mean'),
  ]);
  for (const [name, column] of Object.entries(columns.losses)) {
    if (!losses.has(name)) {
      const place = make('div');
      at('losses').append(make('h3', { text: name }), place);
      losses.set(name, new Chart(place, name, { height: 150 }));
    }
    losses.get(name).show([curve(name, column)]);
  }
  at('no-loss').hidden = losses.size > 0;
  offer(at('number'), Object.keys(columns.points).sort(), 'training.length_mean');
  showChosen();
  if (episode) showEpisode(episode);
}

function showChosen() {
  const column = at('number').value;
  numbers.show(column ? [curve(column, column)] : []);
}

function showEpisode(shown) {
  episode = shown;
  const units = columns.points['reward.label_unit'];
  const unit = units ? units[1][units[1].length - 1] : 0;
  const steps = shown.inferred.map((_, i) => i);
  const scaled = (values) => values.map((value) => (value === null ? null : value * unit));
  const labelled = shown.inferred.some((value) => value !== null);
  const curves = [];
  if (labelled) {
    const own = ownUnit ? 'inferred (in the unit of scores)' : 'inferred';
    const name = unit ? own : 'inferred (in the unit of labels)';
    curves.push({ name, steps, values: unit ? scaled(shown.inferred) : shown.inferred });
  }
  if (shown.true.some((value) => value !== null)) {
    const right = labelled && ownUnit;
    const name = right ? 'true (for you alone, right axis)' : 'true (for you alone)';
    curves.push({ name, steps, values: shown.true, right });
  }
  rewards.show(curves);
  const all = (name, list) => list.map((values, i) => ({ name: `${name} ${i}`, steps, values }));
  observations.show(all('observation', shown.observations));
  actions.show(all('action', shown.actions));
  const left = (name, list, size) =>
    (size > list.length ? ` Of ${size} ${name}s the first ${list.length} are shown.` : '');
  write(at('episode'), `Episode ${shown.episode} of ${shown.source}, phase ${shown.phase} (the first is 0): `
    + `${shown.steps} steps, ${shown.terminated ? 'ended in a terminal state' : 'cut off'}.`
    + `${labelled ? '' : ' Its steps have no inferred rewards.'}`
    + left('observation', shown.observations, shown.observation_size)
    + left('action', shown.actions, shown.action_size));
  const rows = shown.scores.map((score) => [
    `${score.first_step} to ${score.first_step + score.length - 1}`,
    score.value === null ? 'none' : number(score.value),
    score.scorer,
  ]);
  at('segments').replaceChildren(table(['steps', 'score', 'scored by'], rows, 'Its scores'));
}

function showPictures(pictures) {
  const figures = Object.entries(pictures).map(([name, made]) => {
    const source = `/picture/${encodeURIComponent(name)}?${made}`;
    const video = name.endsWith('.mp4');
    const shown = video
      ? make('video', { attributes: { src: source, controls: '', loop: '', 'aria-label': name } })
      : make('img', { attributes: { src: source, alt: 'frames of an episode of each policy' } });
    const film = name.startsWith('film.');
    const words = film ? `${name}: an episode of the first, a later and the last policy` : name;
    return make('figure', { children: [shown, make('figcaption', { text: words })] });
  });
  at('pictures').replaceChildren(...figures);
}

function showVideo(given) {
  const place = at('video');
  if (!given.file) {
    write(at('no-video'), `Episode ${given.episode} of ${given.source} is not drawn: ${given.why}`);
    return;
  }
  write(at('no-video'), '');
  const shown = make('video', {
    attributes: {
      src: `/video/${given.file}`, controls: '', loop: '', muted: '', preload: 'auto',
      'aria-label': `episode ${given.episode} of ${given.source}`,
    },
  });
  shown.muted = true;
  shown.addEventListener('timeupdate', () => {
    const step = Math.floor(shown.currentTime / given.step_seconds);
    for (const chart of [rewards, observations, actions]) chart.point(step);
  });
  const words = `Episode ${given.episode} of ${given.source}. The charts follow the video.`;
  place.replaceChildren(make('figure', {
    children: [shown, make('figcaption', { text: words })],
  }));
}

function showNotes(notes) {
  at('notes').hidden = !notes.length;
  at('notes').replaceChildren(...notes.map((text) => make('li', { text })));
}

at('number').addEventListener('change', showChosen);
showColumns(columns);
rewards.show([]);
observations.show([]);
actions.show([]);
follow(
  {
    run: showRun,
    status: showStatus,
    columns: showColumns,
    episode: showEpisode,
    pictures: showPictures,
    video: showVideo,
    notes: showNotes,
  },
  (state) => {
    connected = state === 'live';
    const again = ended ? 'codetr watch shows the run again' : 'trying again';
    write(at('link'), connected ? '' : `(the server does not answer: ${again})`);
  },
);
