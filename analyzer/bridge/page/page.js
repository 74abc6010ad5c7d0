// Texts come from logs: they are only ever put into the page as text.
const SVG = "http://www.w3.org/2000/svg";
const STALE = 20000, AGAIN = 10000; // milliseconds
const LANE = 26, BINS_AN_HOUR = 30;
const LEVELS = ["well", "warning", "wrong"], STATES = ["Good", "Look at this", "Not working"];
const place = (id) => document.getElementById(id);

function make(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function draw(name, attributes, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function swatch(colour) {
  const element = make("span", { class: "swatch", "aria-hidden": "true" });
  element.style.backgroundColor = `rgb(${colour.join(" ")})`;
  return element;
}

// As many children as there are items, each changed only where it has to be: what somebody reads,
// or has the focus in, stays.
function keep(parent, items, begin, show) {
  while (parent.children.length > items.length) parent.lastElementChild.remove();
  items.forEach((item, index) => {
    const child = parent.children[index] ?? parent.appendChild(begin());
    show(child, item);
  });
}

function showNow({ is_recording: isRecording, rooms }) {
  const said = rooms.length ? rooms
    : [{ room: "", words: isRecording ? "Nothing heard yet" : "Not recording", since: "", why: "" }];
  keep(place("heard"), said, () => make("div", {},
    make("p", { class: "room" }), make("p", { class: "sentence" }), make("p", { class: "since" })),
  (child, { room, words, since, why }) => {
    write(child.children[0], room);
    write(child.children[1], words);
    write(child.children[2], [since, why].filter(Boolean).join(" – "));
    child.children[0].hidden = !room;
    child.children[2].hidden = !child.children[2].textContent;
  });
  keep(place("levels"), rooms.filter(({ level }) => level), () => {
    const bar = make("div", { class: "bar", role: "meter", "aria-valuemin": 0, "aria-valuemax": 100 },
      make("span"));
    return make("div", { class: "level" }, make("span"), bar, make("span", { class: "figure" }));
  }, (child, { room, level: [share, words] }) => {
    const name = room ? `Loudness, ${room}` : "Loudness";
    write(child.children[0], room || name);
    const bar = child.children[1];
    bar.setAttribute("aria-label", name);
    bar.setAttribute("aria-valuenow", Math.round(100 * share));
    bar.setAttribute("aria-valuetext", words);
    bar.firstElementChild.style.width = `${100 * share}%`;
    write(child.children[2], words);
  });
}

function showScenarios(lines) {
  place("scenarios").hidden = !lines.length;
  keep(place("scenario-lines"), lines, () => make("li", {}, make("div", {},
    make("p", { class: "what" }), make("p", { class: "about" }))),
  (child, { what, about }) => {
    write(child.firstElementChild.children[0], what);
    write(child.firstElementChild.children[1], about);
  });
}

function spans(list, width) {
  return list.map(([a, b]) => `M${a * width} 0H${b * width}V${LANE}H${a * width}Z`).join("");
}

// Bins of one height in a row are one mark, and the narrowest is seen.
function marks(bars, width, hours) {
  const step = width / (hours * BINS_AN_HOUR);
  let path = "";
  for (let i = 0; i < bars.length;) {
    let end = i + 1;
    while (end < bars.length && bars[end] === bars[i]) end += 1;
    if (bars[i] !== "0") {
      const top = LANE * (1 - 0.88 * bars[i] / 9);
      path += `M${(i * step).toFixed(1)} ${LANE}V${top.toFixed(1)}h${
        Math.max((end - i) * step, 1.6).toFixed(1)}V${LANE}Z`;
    }
    i = end;
  }
  return path;
}

function set(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

function beginLane(it, room) {
  const path = (attributes) => draw("path", attributes);
  const svg = draw("svg", { role: "img", preserveAspectRatio: "none" }, draw("title", {}), path({ class: "shade" }),
    path({ fill: "url(#unheard)" }), path({ class: "marks", fill: `rgb(${it.colour.join(" ")})` }),
    path({ class: "moment" }));
  const counts = ["today", "last night"].map((when) => {
    const count = make("button", { type: "button", class: "count", "aria-expanded": "false", title: `When, ${when}` });
    count.dataset.about = [it.words, room, when].filter(Boolean).join(", ");
    count.addEventListener("click", () => openTimes(times, counts, count));
    return count;
  });
  const hide = make("button", { type: "button", class: "back" }, `Hide ${it.words.toLowerCase()} everywhere`);
  hide.addEventListener("click", () => showClass(it.label, "no"));
  const times = make("tr", { class: "times", hidden: "" },
    make("td", { colspan: 4 }, make("p", { class: "about" }), hide));
  const cells = [make("td", {}, counts[0]), make("td", {}, counts[1]), make("td")];
  const row = make("tr", {}, make("th", { scope: "row" }, swatch(it.colour), it.words), ...cells);
  return { name: make("div", { class: "name", "aria-hidden": "true" }, it.words), svg, row, times, counts, cells };
}

// Shows below a sound when it was heard; a second click hides the times again.
function openTimes(times, counts, chosen) {
  const isOpen = chosen.getAttribute("aria-expanded") === "true";
  counts.forEach((count) => set(count, "aria-expanded", String(count === chosen && !isOpen)));
  times.hidden = isOpen;
  if (!isOpen) write(times.querySelector("p"), chosen.dataset.times);
}

function showLane({ svg, times, counts, cells }, it, gaps, day, width) {
  const [title, night, unheard, heard, moment] = svg.children;
  write(title, it.told);
  set(svg, "aria-label", it.told);
  set(svg, "viewBox", `0 0 ${width} ${LANE}`);
  set(night, "d", spans(day.nights, width));
  set(unheard, "d", spans(gaps, width));
  set(heard, "d", marks(it.bars, width, day.hours.length));
  set(moment, "d", `M${day.now * width} 0V${LANE}`);
  [it.today, it.night].forEach((value, index) => {
    const count = counts[index];
    cells[index].className = value ? "" : "none";
    count.dataset.times = it.times[index] || (value === 0 ? "Not once." : "Not known.");
    write(count, String(value ?? "not known"));
    set(count, "aria-label", `${count.dataset.about}: ${count.textContent}`);
    if (count.getAttribute("aria-expanded") === "true") write(times.querySelector("p"), count.dataset.times);
  });
  cells[2].className = it.last ? "" : "none";
  write(cells[2], it.last || "not lately");
}

function showHours(svg, day, width) {
  const every = width < 420 ? 4 : 2;
  set(svg, "viewBox", `0 0 ${width} 18`);
  svg.replaceChildren(...day.hours.filter(([, hour]) => hour % every === 0).map(([where, hour]) =>
    draw("text", { x: Math.min(Math.max(where * width, 8), width - 8), y: 13 },
      String(hour).padStart(2, "0"))));
}

function beginRoom({ room, lanes }, isAlone) {
  const begun = lanes.map((lane) => beginLane(lane, isAlone ? "" : room));
  const hours = draw("svg", { class: "hours", "aria-hidden": "true" });
  const heads = ["Sound", "Today", "Last night", "Last heard"];
  const table = make("table", {},
    make("caption", { class: "hidden" }, `How often each sound was heard${isAlone ? "" : `: ${room}`}`),
    make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...begun.flatMap(({ row, times }) => [row, times])));
  const block = make("div", { class: "lanes" }, ...begun.flatMap(({ name, svg }) => [name, svg]), hours);
  const heading = isAlone ? [] : [make("h3", {}, room)];
  const unheard = make("p", { class: "note" }, "Nothing was heard here today.");
  const content = lanes.length ? [block, table] : [unheard];
  return { elements: [...heading, ...content], lanes: begun, hours };
}

let lastDay = null, rooms = [], roomsOf = "";

function showDay(day) {
  lastDay = day;
  write(place("date"), day.title);
  place("legend").hidden = !day.rooms.length;
  const key = JSON.stringify(day.rooms.map(({ room, lanes }) => [room, lanes.map(({ words }) => words)]));
  if (key !== roomsOf) { // else what somebody reads there stays
    roomsOf = key;
    rooms = day.rooms.map((room) => beginRoom(room, day.rooms.length === 1));
    place("rooms").replaceChildren(...rooms.flatMap(({ elements }) => elements));
  }
  day.rooms.forEach(({ gaps, lanes }, index) => {
    const room = rooms[index];
    const width = Math.max(Math.floor(room.hours.getBoundingClientRect().width), 100);
    lanes.forEach((it, number) => showLane(room.lanes[number], it, gaps, day, width));
    showHours(room.hours, day, width);
  });
}

let classes = [];
const shownEvents = new Map(), shownGroups = new Map(); // items of the lists by ids

function choice(name, value, ...words) {
  return make("label", {}, make("input", { type: "radio", name, value, required: "" }), ...words);
}

// A form in which one says what a sound was; `save` is told it, and answers what came of it.
function form(item, { legend, choices, save }) {
  const own = make("input", { type: "text", maxlength: 64, autocomplete: "off", "aria-label": "What was it?" });
  const something = choice("label", "", "Something else:");
  something.classList.add("own");
  something.append(own);
  own.addEventListener("input", () => { something.firstElementChild.checked = true; });
  const problem = make("p", { class: "problem", role: "alert" });
  const button = make("button", {}, "Save");
  const asked = make("form", {}, make("fieldset", {}, make("legend", {}, legend),
    ...choices.map(([label, words]) => choice("label", label, words)), something), problem, button);
  asked.addEventListener("submit", async (submitted) => {
    submitted.preventDefault();
    const label = new FormData(asked).get("label") || own.value.trim();
    if (!label) { write(problem, "Write what it was."); own.focus(); return; }
    button.disabled = true;
    write(problem, "");
    const answer = await save(label);
    button.disabled = false;
    if (answer.error) { write(problem, answer.error); return; }
    write(item.said, answer.said);
    item.details.open = false;
    item.summary.focus();
  });
  return asked;
}

async function send(path, asked) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(asked),
    });
    if (answer.status === 200 || answer.status === 422) return await answer.json();
    return { error: "It was not saved: open the page by its full address again." };
  } catch {
    return { error: "It was not saved: there is no connection to the box." };
  }
}

// An item of a list of sounds, with a form that `question` describes when it is opened.
function begin(question) {
  const item = {
    what: make("p", { class: "what" }),
    about: make("p", { class: "about" }),
    said: make("p", { class: "said", role: "status" }),
    summary: make("summary", {}, "That was …"),
  };
  item.details = make("details", {}, item.summary);
  item.element = make("li", {}, make("div", {}, item.what, item.about, item.said), item.details);
  item.summary.append(item.hint = make("span", { class: "hidden" }));
  item.details.addEventListener("toggle", () => {
    if (item.details.open && item.details.children.length === 1) item.details.append(form(item, question(item)));
    if (!item.details.open) item.details.querySelector("form")?.remove();
  });
  return item;
}

// The items of a list in its order, by the ids of what they show; one in which somebody is just
// saying what it was stays.
function arrange(list, items, entries, begun, show) {
  const ids = new Set(entries.map(({ id }) => id));
  for (const [id, item] of items) {
    if (ids.has(id) || item.details.open) continue;
    item.element.remove();
    items.delete(id);
  }
  let before = null;
  for (const entry of entries) {
    let item = items.get(entry.id);
    if (!item) items.set(entry.id, item = begun(entry));
    show(item, entry);
    const next = before ? before.nextSibling : list.firstChild;
    if (item.element !== next) list.insertBefore(item.element, next);
    before = item.element;
  }
}

// Hides a class from all that the box tells, or shows it again.
async function showClass(label, show) {
  const answer = await send("show", { show, label });
  write(place("hidden-said"), answer.error ?? answer.said);
}

function showHidden(hidden) {
  keep(place("hidden-classes"), hidden, () => {
    const button = make("button", { type: "button", class: "back" });
    const child = make("li", {}, make("span"), " ", button);
    button.addEventListener("click", () => showClass(child.dataset.label, "yes"));
    return child;
  }, (child, [label, words]) => {
    child.dataset.label = label;
    write(child.firstElementChild, words);
    write(child.lastElementChild, `Show ${words.toLowerCase()} again`);
  });
  place("hidden-sounds").hidden = !hidden.length;
}

function beginEvent({ id, words, colour, time }) {
  const item = begin(() => ({
    legend: `${words} at ${time}: that was …`,
    choices: [...classes, ["television", "From the television or radio"], ["silence", "Nothing"]],
    save: (label) => send("mark", { event: id, label }),
  }));
  item.what.append(swatch(colour), words);
  return item;
}

function showEvents({ events, classes: known, hidden }) {
  classes = known;
  showHidden(hidden);
  arrange(place("events"), shownEvents, events, beginEvent, (item, event) => {
    write(item.about, [event.time, event.length, event.sure, event.room].filter(Boolean).join(" · "));
    write(item.said, event.said);
    write(item.hint, ` (${event.words}, ${event.time})`);
  });
  place("no-events").hidden = events.length > 0;
}

function beginGroup({ id }) {
  const item = begin(({ words }) => ({
    legend: `${words}: that was …`,
    choices: classes,
    save: (label) => send("group", { group: id, label }),
  }));
  [item.heard, item.listen] = [make("p", { class: "about" }), make("p", { class: "about" })];
  item.about.after(item.heard, item.listen);
  item.back = make("button", { type: "button", class: "back" }, "Take back");
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

function showRecurring({ looked, more, groups }) {
  place("recurs").hidden = !groups.length;
  write(place("looked"), looked ? `, as they were found at ${looked}` : "");
  write(place("more"), more);
  arrange(place("recurring"), shownGroups, groups, beginGroup, (item, group) => {
    item.words = group.words;
    write(item.what, group.words);
    write(item.about, group.about);
    write(item.heard, group.heard);
    write(item.listen, group.listen);
    write(item.said, group.said);
    write(item.hint, ` (${group.words})`);
    write(item.backHint, ` the name ${group.words}`);
    item.back.hidden = !group.is_named;
  });
}

function showHealth(lines) {
  keep(place("health"), lines, () => make("li", {},
    make("span", { class: "state" }), " ", make("span")),
  (child, { what, level, text }) => {
    child.className = LEVELS[level];
    write(child.firstElementChild, `${["✓", "!", "✕"][level]} ${what}: ${STATES[level]}`);
    write(child.lastElementChild, text ? `(${text})` : "");
  });
  const wrong = lines.filter(({ level }) => level > 0).map(({ what }) => what);
  write(place("attention").firstElementChild, `Needs a look: ${wrong.join(", ")}`);
  place("attention").hidden = !wrong.length;
}

let clock = "";

function showHome(home) {
  clock = home.clock;
  write(place("home"), home.home);
  write(place("clock"), clock);
  if (document.title !== home.home) document.title = home.home;
}

function trouble(text) {
  const element = place("trouble");
  if (text) write(element, text + (clock ? ` What you see is of ${clock}.` : ""));
  element.hidden = !text;
}

let stale = 0;

function beat() {
  trouble("");
  clearTimeout(stale);
  stale = setTimeout(() => trouble("There is no news from the box."), STALE);
}

function connect() {
  const source = new EventSource("events");
  const shows = { home: showHome, now: showNow, scenarios: showScenarios, day: showDay, events: showEvents,
    recurring: showRecurring, health: showHealth };
  for (const [name, show] of Object.entries(shows)) {
    source.addEventListener(name, ({ data }) => show(JSON.parse(data)));
  }
  source.addEventListener("beat", beat);
  source.addEventListener("error", () => {
    if (source.readyState !== EventSource.CLOSED) {
      trouble("There is no connection to the box.");
      return;
    }
    trouble("The box does not answer this page: perhaps too many are open. It is tried again; if that does not help, open the page by its full address.");
    setTimeout(connect, AGAIN);
  });
}

let width = innerWidth;
addEventListener("resize", () => {
  if (lastDay && innerWidth !== width) showDay(lastDay);
  width = innerWidth;
});
connect();
