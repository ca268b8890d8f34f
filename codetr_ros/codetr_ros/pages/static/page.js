// What all pages share. What comes from the server is put into a page as text, never as markup.

/** The element with this id. */
export function at(id) {
  return document.getElementById(id);
}

/** A new element with a class, a text, and further attributes and children. */
export function make(tag, { className, text, attributes = {}, children = [] } = {}) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Set the text of an element, if it is another: screen readers announce changes. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A number for people: four digits, and an exponent where it needs one. */
export function number(value) {
  if (value === null || value === undefined) return '–';
  if (Number.isInteger(value) && Math.abs(value) < 1e9) return String(value);
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

/** The value of one of the colours in base.css. */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/**
 * Follow the live values of the server. `handlers` has a function for each name; `onState` is
 * called with 'live' or 'lost'. The browser connects again by itself.
 */
export function follow(handlers, onState = () => {}) {
  const source = new EventSource('/events');
  source.addEventListener('open', () => onState('live'));
  source.addEventListener('error', () => onState('lost'));
  for (const [name, handle] of Object.entries(handlers)) {
    source.addEventListener(name, (event) => handle(JSON.parse(event.data)));
  }
  return source;
}

/**
 * Send a value to the server; resolves to its answer, or throws an Error with its words. `signal`
 * may abort it.
 */
export async function send(path, value, signal) {
  const answer = await fetch(path, {
    method: 'POST',
    headers: { 'Content-Type': 'application/json' },
    body: JSON.stringify(value),
    signal,
  });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}
