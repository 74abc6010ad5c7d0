// Elements and texts. Texts come from logs: they are only ever put into the page as text.
import texts from "./words.js";

const SVG = "http://www.w3.org/2000/svg";
export const language = document.documentElement.lang;
export const place = (id) => document.getElementById(id);

export function say(key, values = {}) {
  return texts[`page.${key}`].replace(/\{(\w+)\}/g, (_, name) => values[name]);
}

export function count(key, number, unsure = 0) {
  return say(`${key}.${number === 1 ? "one" : "other"}`, { count: counted(number, unsure) });
}

// A count, those apart that are not sure: 2 (+3?), or 3? if none is sure. It breaks at the thin space.
export function counted(value, unsure) {
  if (!unsure) return value.toLocaleString(language);
  return unsure === value ? `${value}?` : `${value - unsure}\u2009(+${unsure}?)`;
}

// A count for a screen reader, which would read 2 (+3?) sign by sign: 2, perhaps 3 more.
export function spoken(value, unsure) {
  if (!unsure) return counted(value);
  return unsure === value ? say("spoken.unsure", { count: value })
    : say("spoken.partly", { sure: value - unsure, count: unsure });
}

const BREAKS = texts["page.breaks"].split(" ").map((word) => [word.replaceAll("|", ""), word.replaceAll("|", "\u00ad")]);

// A name whose long words may be broken: a browser may have no dictionary of the language.
export function breakable(words) {
  return BREAKS.reduce((text, [word, broken]) => text.replace(word, broken), words);
}

// The name of a class as it is written inside of a sentence.
export function inside(words) {
  return texts["page.nouns"] === "lower case" ? words.toLowerCase() : words;
}

export function make(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

export function draw(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// A number stays on the line of what it counts, and a range of hours on one.
export function write(element, text) {
  const glued = text.replace(/([\d½]) (?=\p{L})/gu, "$1\u00a0").replace(/(\d–)(?=\d)/g, "$1\u2060");
  if (element.textContent !== glued) element.textContent = glued;
}

export function set(element, name, value) {
  if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
}

export function swatch(of) {
  const element = make("span", { class: "swatch", "aria-hidden": "true" });
  colour(element, of);
  return element;
}

// The colour of a class, also for a dark ground: there a dark one is made lighter, and so stays apart from
// a bright one of the same hue.
export function colour(element, of) {
  const [red, green, blue] = of.map((part) => (part / 255) ** 2.2);
  const isDark = 0.21 * red + 0.72 * green + 0.07 * blue < 0.2;
  const light = isDark ? of.map((part) => Math.round(0.4 * part + 0.6 * 255)) : of;
  element.style.setProperty("--class", `rgb(${of.join(" ")})`);
  element.style.setProperty("--light", `rgb(${light.join(" ")})`);
}

// As many children as there are items, each changed only where it has to be: what somebody reads,
// or has the focus in, stays.
export function keep(parent, items, begin, show) {
  while (parent.children.length > items.length) parent.lastElementChild.remove();
  items.forEach((item, index) => {
    const child = parent.children[index] ?? parent.appendChild(begin());
    show(child, item);
  });
}

export async function send(path, content) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(content),
    });
    if (answer.status === 200 || answer.status === 422) return await answer.json();
    return { error: say("not saved") };
  } catch {
    return { error: say("not connected") };
  }
}

// The answer to a question to the box, or an object with an error.
export async function ask(path) {
  try {
    const answer = await fetch(path);
    if (answer.status === 200 || answer.status === 422) return await answer.json();
  } catch { /* no connection */ }
  return { error: say("not read") };
}
