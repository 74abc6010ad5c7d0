// Lists of sounds: what they were, what they really were, and their kept sound.
import { ask, breakable, count, counted, inside, keep, language, make, place, say, send, spoken, swatch, write } from "./elements.js";

const REST = 8000; // milliseconds without a touch, after which a list may change
const SEPARATOR = "\u00a0· "; // ends a line, and begins none
const BRIEF = 6; // sounds that are shown at first
const SINGLE = 2; // newest sounds of a class that are entries of their own, if more than one more needs a look
const AGAIN = 60000; // after which it is asked again whether sound was kept
let classes = [], isSoundAllowed = false;
const lists = { look: new Map(), events: new Map(), recurring: new Map() }; // items by ids

// Kept sound

const playable = new Set(), requested = new Map(); // ids; when each was asked for
const buttons = new Set();
let playing = null, audio = null;
const playProblem = make("p", { class: "problem", role: "alert" }); // of the sound that was to be played last

export function allowSound(isAllowed) { isSoundAllowed = isAllowed; }

// A button that plays the sound of the first of some events that has any.
export function playButton(ids, name) {
  const button = make("button", { type: "button", class: "play", hidden: "" }, "▶");
  const show = () => {
    if (!button.isConnected && button.wasShown) { buttons.delete(show); return; }
    button.wasShown = button.isConnected;
    const isOn = playing?.button === button;
    write(button, isOn ? "■" : "▶");
    button.setAttribute("aria-label", isOn ? say("stop") : say("play", { what: name() }));
    button.hidden = !ids().some((id) => playable.has(id));
  };
  button.addEventListener("click", () => play(button, ids().find((id) => playable.has(id))));
  buttons.add(show);
  return button;
}

function showButtons() { for (const show of [...buttons]) show(); }

// Asks the box once which of some events have sound.
export async function showPlayable(ids) {
  const now = Date.now();
  const wanted = isSoundAllowed
    ? ids.filter((id) => !playable.has(id) && now - (requested.get(id) ?? 0) > AGAIN).slice(0, 50) : [];
  wanted.forEach((id) => requested.set(id, now));
  if (wanted.length) {
    const found = await ask(`kept?${wanted.map(encodeURIComponent).join("&")}`);
    if (Array.isArray(found)) found.forEach((id) => playable.add(id));
  }
  showButtons();
}

function stop() {
  const last = playing;
  playing = null;
  last?.source?.stop();
  showButtons();
}

async function play(button, id) {
  const isSame = playing?.button === button;
  stop();
  if (isSame) return;
  playProblem.remove();
  audio ??= new AudioContext();
  const own = playing = { button };
  showButtons();
  try {
    await audio.resume();
    const answer = await fetch(`sound?${encodeURIComponent(id)}`);
    if (answer.status !== 200) throw new Error((await answer.json()).error);
    const sound = await audio.decodeAudioData(await answer.arrayBuffer());
    if (playing !== own) return;
    own.source = new AudioBufferSourceNode(audio, { buffer: sound });
    own.source.connect(audio.destination);
    own.source.addEventListener("ended", () => { if (playing === own) stop(); });
    own.source.start();
  } catch (error) {
    if (playing === own) stop();
    write(playProblem, error.name === "Error" && error.message ? error.message : say("no sound"));
    button.closest("li")?.append(playProblem);
  }
}

// What a sound really was

function choice(name, value, ...words) {
  return make("label", {}, make("input", { type: "radio", name, value, required: "" }), ...words);
}

// A form in which one says what a sound was; `save` is told it, and answers what came of it.
function form(item, { legend, choices, elsewhere = [], leave, save }) {
  const own = make("input", { type: "text", maxlength: 64, autocomplete: "off", "aria-label": say("what") });
  const something = choice("label", "", say("own")), first = elsewhere.map(([label, words]) => choice("label", label, words));
  something.classList.add("own");
  for (const each of [...first, something]) each.classList.add("other");
  something.append(own);
  own.addEventListener("input", () => { something.firstElementChild.checked = true; });
  const problem = make("p", { class: "problem", role: "alert" });
  const button = make("button", {}, say("save")), cancel = make("button", { type: "button", class: "quiet" }, say("cancel"));
  const question = make("form", {}, make("fieldset", {}, make("legend", {}, legend),
    ...first, ...choices.map(([label, words]) => choice("label", label, breakable(words))), something), problem, make("div", { class: "save" }, button, cancel));
  if (leave) {
    const unknown = make("button", { type: "button", class: "quiet" }, say("do not know"));
    unknown.addEventListener("click", () => { leave(); close(); });
    cancel.after(unknown);
  }
  question.addEventListener("submit", async (submitted) => {
    submitted.preventDefault();
    const label = new FormData(question).get("label") || own.value.trim();
    if (!label) { write(problem, say("write")); own.focus(); return; }
    button.disabled = true;
    write(problem, "");
    const answer = await save(label);
    button.disabled = false;
    if (answer.error) { write(problem, answer.error); return; }
    item.isAnswered = true;
    showAnswer(item, answer.said);
    close();
  });
  cancel.addEventListener("click", close);
  function close() {
    item.details.open = false;
    item.summary.focus();
  }
  return question;
}

// Sounds of which somebody does not know what they were: this browser asks no more.
const LEFT_OPEN = "left open", MOST_LEFT = 200;
const leftOpen = new Set(readLeftOpen());

function readLeftOpen() {
  try { return JSON.parse(localStorage.getItem(LEFT_OPEN)) ?? []; } catch { return []; } // a browser may forbid it
}

function leaveOpen(item) {
  leftOpen.add(item.entry.id);
  try { localStorage.setItem(LEFT_OPEN, JSON.stringify([...leftOpen].slice(-MOST_LEFT))); } catch { /* until it is closed */ }
  item.isAnswered = true;
  showAnswer(item, say("left open"));
}

const isDone = ({ id, said }) => said || leftOpen.has(id);

function showAnswer(item, said) {
  write(item.said, said);
  item.element.classList.toggle("reviewed", Boolean(said) && item.isReviewable);
  const isAsked = item.isReviewable && item.entry.look && !item.entry.doubtful && !said;
  write(item.prompt, say(isAsked ? "no" : "that was"));
  if (!item.yes) return;
  if (!isAsked && document.activeElement === item.yes) item.summary.focus();
  item.yes.hidden = !isAsked;
}

// Sounds of which one is asked whether they are right: of each class the newest, and the others behind
// one tap, as are those that were answered.
const TELEVISION = "television", ANSWERED = "answered", GREY = [150, 158, 170]; // of a fold of several classes
const unfolded = new Set(); // keys of folds
const sum = (numbers) => numbers.reduce((total, each) => total + each, 0);

function folded(every) {
  const done = every.filter((each) => isDone(each) && !lists.look.get(each.id)?.isAnswered), look = every.filter((each) => !done.includes(each));
  const entries = [], seen = new Map();
  for (const entry of look) {
    const same = entry.doubtful ? [] : look.filter(({ label, doubtful, room }) => label === entry.label && room === entry.room && !doubtful);
    const key = `${entry.label} ${entry.room}`, number = seen.get(key) ?? 0;
    seen.set(key, number + 1);
    if (same.length <= SINGLE + 1 || number < SINGLE) entries.push({ ...entry, isFolded: false });
    else if (number === SINGLE) {
      const earlier = same.slice(SINGLE);
      const numbers = [sum(earlier.map(({ ids }) => ids.length)), sum(earlier.map(({ unsure }) => unsure))];
      const often = count("earlier", ...numbers), inWords = say("spoken.earlier", { count: spoken(...numbers) });
      const about = earlier.map((each) => [timeOf(each), each.room].filter(Boolean).join(" ")).join(", ");
      entries.push({ id: `fold ${key}`, key, colour: entry.colour, words: entry.words, often, inWords, about },
        ...earlier.map((each) => ({ ...each, isFolded: !unfolded.has(key) })));
    }
  }
  if (done.length) {
    entries.push({ id: `fold ${ANSWERED}`, key: ANSWERED, colour: GREY, words: say(look.length ? "answered" : "all answered"),
      often: sum(done.map(({ ids }) => ids.length)).toLocaleString(language), about: done.map((each) => each.time).join(", ") },
    ...done.map((each) => ({ ...each, isFolded: !unfolded.has(ANSWERED) })));
  }
  return entries;
}

// Other sounds: those of a television, which do not count, behind one tap at the place of the newest.
function withTelevisionFolded(others) {
  const key = TELEVISION, uncounted = others.filter((entry) => entry.is_uncounted);
  if (uncounted.length <= SINGLE) return others;
  const oldest = uncounted.reduce((first, each) => (each.span[0] < first.span[0] ? each : first));
  const newest = uncounted.reduce((last, each) => (each.span[1] > last.span[1] ? each : last));
  const often = new Map();
  for (const { words, ids } of uncounted) often.set(words, (often.get(words) ?? 0) + ids.length);
  const classesOften = [...often].sort((a, b) => b[1] - a[1]).map(([words, number]) => `${words} ${counted(number)}`).join(", ");
  const fold = { id: `fold ${key}`, key, colour: GREY, words: say("beside television"),
    often: count("not counted", sum(often.values())), about: `${say("span", { first: oldest.span_words[0], last: newest.span_words[1] })}${SEPARATOR}${classesOften}` };
  return others.flatMap((entry) => {
    if (!entry.is_uncounted) return [entry];
    return [...(entry === uncounted[0] ? [fold] : []), ...(unfolded.has(key) ? [entry] : [])];
  });
}

function beginFold({ key, colour, words }) {
  const item = { details: { open: false }, often: make("span", { class: "often" }), about: make("p", { class: "about" }),
    button: make("button", { type: "button", class: "quiet fold" }) };
  item.element = make("li", { class: "fold" }, make("div", {},
    make("p", { class: "what" }, swatch(colour), breakable(words), item.often), item.about), item.button);
  item.button.addEventListener("click", () => {
    if (!unfolded.delete(key)) unfolded.add(key);
    if (key === TELEVISION) place("events").classList.remove("brief");
    showList(shownEvents);
  });
  return item;
}

// When an entry was, and whether all of it, or how much, is not sure: 03:21?, or 03:21 to 03:30 (2?).
function timeOf({ time, unsure, ids }) {
  if (!unsure) return time;
  return unsure === ids.length ? `${time}?` : `${time} (${unsure}?)`;
}

function showFold(item, { key, often, inWords = often, about, words }) {
  const isOpen = unfolded.has(key);
  write(item.often, `${SEPARATOR}${often}`);
  write(item.about, about);
  item.button.setAttribute("aria-expanded", String(isOpen));
  item.button.setAttribute("aria-label", `${say(isOpen ? "fold" : "unfold")}: ${words}, ${inWords}`);
  write(item.button, say(isOpen ? "fold" : "unfold"));
}

// An item of a list of sounds, with a form that `question` describes when it is opened.
function begin(question) {
  const item = {
    what: make("p", { class: "what" }),
    about: make("p", { class: "about" }),
    said: make("p", { class: "said", "aria-live": "polite" }),
    prompt: make("span", {}, say("that was")),
    summary: make("summary"),
    isReviewable: false,
  };
  item.details = make("details", {}, item.summary);
  item.element = make("li", {}, make("div", {}, item.what, item.about, item.said), item.details);
  item.summary.append(item.prompt, item.hint = make("span", { class: "hidden" }));
  item.details.addEventListener("toggle", () => {
    if (item.details.open && item.details.children.length === 1) item.details.append(form(item, question(item)));
    if (!item.details.open) item.details.querySelector("form")?.remove();
  });
  return item;
}

// The items of a list in its order, by the ids of what they show. One stays in which somebody is just
// saying what it was, and a single time that was answered stays with its answer, though it counts no more.
function arrange(list, items, entries, begun, show) {
  const ids = new Set(entries.map(({ id }) => id));
  const stays = ({ details, element, entry, isAnswered }) =>
    element.isConnected && (details.open || (isAnswered && entry?.isSingle));
  for (const [id, item] of items) {
    if (ids.has(id) || stays(item)) continue;
    item.element.remove();
    items.delete(id);
  }
  let before = null;
  for (const entry of entries) {
    let item = items.get(entry.id);
    if (!item) items.set(entry.id, item = begun(entry));
    show(item, entry);
    let next = before ? before.nextSibling : list.firstChild;
    while (next && !entries.some(({ id }) => items.get(id)?.element === next)) next = next.nextSibling;
    if (item.element !== next) list.insertBefore(item.element, next);
    before = item.element;
  }
}

function beginBout(entry) {
  const item = begin(() => {
    const { id, label, words, time, doubtful, isSingle } = item.entry;
    const others = classes.filter(([name]) => doubtful || name !== label);
    const isClear = !doubtful && label !== "unknown" && item.yes.hidden; // else there is a button for it
    return {
      legend: say("question", { class: words, time }),
      choices: [...(isClear ? [[label, say("right", { class: words })]] : []), ...others],
      elsewhere: [["television", say("television")], ["silence", say("silence")]],
      leave: item.entry.look && !doubtful && (() => leaveOpen(item)),
      save: (chosen) => send(isSingle ? "mark-one" : "mark", { event: id, label: chosen }),
    };
  });
  item.entry = entry;
  item.isReviewable = true;
  item.what.append(...(entry.isSingle ? [entry.time] : [swatch(entry.colour), breakable(entry.words)]), item.often = make("span", { class: "often" }));
  item.play = playButton(() => item.entry.ids, () => `${item.entry.words}, ${item.entry.time}`);
  item.yes = make("button", { type: "button", class: "quiet yes", hidden: "" }, say("yes"), item.yesHint = make("span", { class: "hidden" }));
  item.yes.addEventListener("click", () => confirm(item));
  item.details.before(item.play, item.yes);
  return item;
}

// Marks a sound with the class that it already has.
async function confirm(item) {
  item.yes.disabled = true;
  const { said, error } = await send("mark", { event: item.entry.id, label: item.entry.label });
  item.yes.disabled = false;
  if (error) { write(item.said, error); return; }
  item.isAnswered = true;
  showAnswer(item, said);
}

function showBout(item, entry) {
  item.entry = entry;
  item.element.hidden = Boolean(entry.isFolded) && !item.details.open;
  write(item.often, entry.times ? `${SEPARATOR}${entry.times}` : "");
  write(item.about, entry.isSingle ? entry.about : [entry.time, entry.length, entry.sure, entry.beside, entry.room].filter(Boolean).join(SEPARATOR));
  if (entry.said || !item.isAnswered) showAnswer(item, entry.said); // the log has an answer later
  const hint = ` (${[entry.words, entry.time, entry.room].filter(Boolean).join(", ")})`;
  write(item.hint, hint);
  write(item.yesHint, hint);
}

// The entries of single events, such as those of a count.
export function showEntries(list, items, entries) {
  arrange(list, items, entries, beginBout, showBout);
  showPlayable(entries.map(({ id }) => id));
}

let latest = null, shownIds = null, isPast = false, shownEvents = [];
let touched = -Infinity;

function showList(events) {
  shownEvents = events;
  const look = events.filter((each) => each.look), others = withTelevisionFolded(events.filter((each) => !each.look));
  const begun = (entry) => (entry.key ? beginFold : beginBout)(entry);
  const show = (item, entry) => (entry.key ? showFold : showBout)(item, entry);
  arrange(place("look"), lists.look, folded(look), begun, show);
  arrange(place("events"), lists.events, others, begun, show);
  place("looked-at").hidden = !look.length;
  write(place("events-heading"), say(look.length ? "other sounds" : isPast ? "sounds of" : "sounds"));
  place("no-events").hidden = events.length > 0;
  write(place("all-events"), say("all", { count: others.length - BRIEF }));
  place("all-events").hidden = others.length <= BRIEF || !place("events").classList.contains("brief");
  showPlayable(events.flatMap(({ ids }) => ids));
}

// Whether nobody reads, points at or answers in the lists just now, or in what they would move.
function isAtRest() {
  const sections = [place("looked-at"), place("sounds")];
  if (document.querySelector(".listed :focus-visible, .listed details[open], #counts .panel")) return false;
  if (matchMedia("(hover: hover)").matches && sections.some((each) => each.matches(":hover"))) return false;
  const isReadFromItsTop = ({ top, bottom }) => top > innerHeight || bottom < 0 || top >= 0;
  return sections.every((each) => isReadFromItsTop(each.getBoundingClientRect())) && Date.now() - touched > REST;
}

// What was answered goes behind its tap when nobody looks.
function foldAnswered() {
  const answered = [...lists.look.values()].filter(({ isAnswered, entry }) => isAnswered && entry && isDone(entry));
  if (!answered.length || !isAtRest()) return;
  for (const item of answered) item.isAnswered = false;
  showList(shownEvents);
}

function showLatest(isWanted) {
  if (!latest || isPast) return;
  const fresh = shownIds ? latest.filter(({ id }) => !shownIds.has(id)).length : 0;
  const button = place("new-sounds");
  if (!fresh || isWanted || isAtRest()) {
    shownIds = new Set(latest.map(({ id }) => id));
    button.hidden = true;
    showList(latest);
    return;
  }
  for (const entry of latest) { // those that are shown may go on
    const item = lists.look.get(entry.id) ?? lists.events.get(entry.id);
    if (item) showBout(item, { ...entry, isFolded: item.entry.isFolded });
  }
  write(button, count("new", fresh));
  button.hidden = false;
}

export function showEvents({ events, classes: known, hidden }) {
  classes = known;
  showHidden(hidden);
  latest = events;
  const labels = new Set([...known.map(([label]) => label), ...events.map(({ label }) => label)]);
  for (const id of [...(shownIds ?? [])]) { // a class that was hidden goes at once
    const item = lists.look.get(id) ?? lists.events.get(id);
    if (item && !labels.has(item.entry.label)) shownIds = null;
  }
  showLatest(false);
}

// The sounds of a past day; without any argument those of today again.
export function showSoundsOf(events) {
  isPast = events !== undefined;
  unfolded.clear();
  write(place("no-events"), say(isPast ? "none of day" : "none"));
  place("new-sounds").hidden = true;
  if (isPast) showList(events);
  else showLatest(true);
}

for (const kind of ["touchstart", "wheel", "keydown"]) {
  addEventListener(kind, () => { touched = Date.now(); }, { passive: true });
}
setInterval(() => {
  if (!place("new-sounds").hidden) showLatest(false);
  foldAnswered();
}, 2000);
place("new-sounds").addEventListener("click", () => {
  const isAsked = latest.some(({ id, look }) => look && !shownIds?.has(id));
  showLatest(true);
  const section = place(isAsked ? "looked-at" : "sounds");
  if (section.getBoundingClientRect().top < 0) section.scrollIntoView();
});

place("all-events").addEventListener("click", () => {
  const next = place("events").children[BRIEF]; // where one reads on
  place("events").classList.remove("brief");
  place("all-events").hidden = true;
  next.querySelector("summary").focus();
});

// Classes that are hidden

async function showClass(label) {
  const answer = await send("show", { show: "yes", label });
  write(place("hidden-said"), answer.error ?? answer.said);
}

function showHidden(hidden) {
  keep(place("hidden-classes"), hidden, () => {
    const button = make("button", { type: "button", class: "back" });
    const child = make("li", {}, make("span"), " ", button);
    button.addEventListener("click", () => showClass(child.dataset.label));
    return child;
  }, (child, [label, words]) => {
    child.dataset.label = label;
    write(child.firstElementChild, words);
    write(child.lastElementChild, say("show", { class: inside(words) }));
  });
  place("hidden-sounds").hidden = !hidden.length;
}

// Sounds that recur

function beginGroup({ id }) {
  const item = begin(({ words }) => ({
    legend: say("question of group", { class: words }),
    choices: classes,
    save: (label) => send("group", { group: id, label }),
  }));
  [item.heard, item.listen] = [make("p", { class: "about" }), make("p", { class: "about" })];
  item.about.after(item.heard, item.listen);
  item.back = make("button", { type: "button", class: "back" }, say("take back"));
  item.back.append(item.backHint = make("span", { class: "hidden" }));
  item.details.after(item.back);
  item.back.addEventListener("click", async () => {
    item.back.disabled = true;
    const answer = await send("group", { group: id, label: "" });
    item.back.disabled = false;
    write(item.said, answer.error ?? answer.said);
  });
  return item;
}

export function showRecurring({ looked, more, groups }) {
  place("recurs").hidden = !groups.length;
  write(place("recurring-hint"), say("recurring hint", { found: looked ? say("found", { time: looked }) : "" }));
  write(place("more"), more);
  arrange(place("recurring"), lists.recurring, groups, beginGroup, (item, group) => {
    item.words = group.words;
    write(item.what, group.words);
    write(item.about, group.about);
    write(item.heard, group.heard);
    write(item.listen, group.listen);
    write(item.said, group.said);
    write(item.hint, ` (${group.words})`);
    write(item.backHint, ` ${say("take back name", { class: group.words })}`);
    item.back.hidden = !group.is_named;
  });
}
