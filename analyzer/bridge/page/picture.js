// A day as one picture, its counts, and the times behind a lane or a count.
import { breakable, colour, count, counted, draw, inside, keep, make, place, say, send, set, spoken, swatch, write } from "./elements.js";
import { showEntries } from "./sounds.js";

const LANE = 36, NAME = 18, STRIP = 20, GAP = 3, HOURS = 20, NARROWEST = 4; // pixels; on a phone, names are above their strips
const WIDE = 700; // pixels of the page, from which on the names of lanes are left of the picture
const MOST_NAME = 0.3; // of the width
const BINS_AN_HOUR = 30;
let open = null; // the lane or count whose times are shown

// Bins in a row are one mark, and the narrowest is seen.
function marks(bars, width, hours, top, height, share) {
  const step = width / (hours * BINS_AN_HOUR), foot = top + height;
  return [...bars.matchAll(/1+/g)].map(({ 0: { length }, index }) =>
    `M${(index * step).toFixed(1)} ${foot}V${(foot - height * share).toFixed(1)}h${
      Math.max(length * step, NARROWEST).toFixed(1)}V${foot}Z`).join("");
}

// The marks of a class, from the back, as in the report: pale what does not count, half as high what
// is not sure, and the rest.
const KINDS = [["pale", "marks pale", 1], ["unsure_bars", "marks unsure", 0.5], ["sure_bars", "marks", 1]];

export const beginMarks = () => KINDS.map(([, kind]) => draw("path", { class: kind }));

export function showMarks(paths, lane, width, hours, top, height) {
  KINDS.forEach(([key, , share], index) => {
    set(paths[index], "d", marks(lane[key], width, hours, top, height, share));
    colour(paths[index], lane.colour);
  });
}

// Spans of a day in bands of the picture, each with its top and height.
export function spans(list, width, bands) {
  return bands.flatMap(([top, height]) =>
    list.map(([a, b]) => `M${a * width} ${top}H${b * width}v${height}H${a * width}Z`)).join("");
}

const lines = (places, width, bands) =>
  bands.flatMap(([top, height]) => places.map((where) => `M${where * width} ${top}v${height}`)).join("");

function timesOf(it, index) {
  const { times, before } = it.times[index];
  return { it, times, before, value: [it.count, ...it.counts][index], when: [dayName(), ...shown.columns][index] };
}

// Shows when a sound was heard, below the picture or the count that was chosen; a second tap closes.
function choose(chosen) {
  const same = open?.button === chosen.button;
  close();
  if (same) return;
  const close_ = make("button", { type: "button", class: "quiet back" });
  open = { ...chosen, heading: make("p", { class: "what" }), list: make("ol", { class: "sounds times", role: "list" }), items: new Map(),
    note: make("p", { class: "about" }), hide: close_ };
  close_.addEventListener("click", () => hideClass(open.data().it.label));
  open.panel = make("div", { class: "panel" }, open.heading, open.list, open.note, close_);
  open.list.addEventListener("toggle", () => { if (open) showTimes(); }, true); // one that was open and counts no more may go now
  open.where(open.panel);
  set(chosen.button, "aria-expanded", "true");
  showTimes();
}

function close() {
  if (!open) return;
  set(open.button, "aria-expanded", "false");
  (open.panel.closest("tr.times") ?? open.panel).remove();
  open = null;
}

function showTimes() {
  const data = open.data();
  if (!data) { close(); return; }
  const { it, times, before, value, when } = data;
  write(open.heading, say("times of", { what: it.words, when }));
  showEntries(open.list, open.items, times.map(([time, id, about, said]) =>
    ({ id, ids: [id], label: it.label, words: it.words, time, about, said, isSingle: true })));
  let text = before ? say("before", { count: before }) : "";
  if (!times.length) text = value === null ? `${capital(say("not known"))}.` : say("not once");
  write(open.note, [text, value === it.count && uncountedNote(it)].filter(Boolean).join(" "));
  write(open.hide, say("hide", { class: inside(it.words) }));
}

function uncountedNote({ uncounted, uncounted_times: times }) {
  if (!uncounted) return "";
  const text = count("uncounted in words", uncounted);
  return times ? say("uncounted at", { text, times }) : say("uncounted note", { text });
}

const figureOf = ({ count: value, unsure }) => (value === null ? "–" : counted(value, unsure[0]));
const capital = (text) => text[0].toUpperCase() + text.slice(1);
const dayName = () => shown.now === null ? shown.title : say("since evening");

async function hideClass(label) {
  const answer = await send("show", { show: "no", label });
  write(place("hidden-said"), answer.error ?? answer.said);
}

function beginLane(room, number) {
  const name = draw("text", { class: "name" }), figure = draw("text", { class: "count" });
  const lane = { name, figure, marks: beginMarks(), line: draw("path", { class: "line" }), hit: draw("rect", { class: "hit" }) };
  lane.element = draw("g", { class: "lane", role: "button", tabindex: 0, "aria-expanded": "false" },
    lane.hit, lane.line, ...lane.marks, name, figure);
  const chosen = { button: lane.element, where: (panel) => room.svg.after(panel),
    data: () => { const it = room.sounded.find(({ label }) => label === lane.label); return it && timesOf(it, 0); } };
  lane.element.addEventListener("click", () => choose(chosen));
  lane.element.addEventListener("keydown", (pressed) => {
    if (pressed.key === "Enter" || pressed.key === " ") { pressed.preventDefault(); choose(chosen); }
  });
  return lane;
}

function beginRow(room, label, columns) {
  const find = () => room.lanes.find((each) => each.label === label);
  const counts = columns.map((_, index) => {
    const button = make("button", { type: "button", class: "count", "aria-expanded": "false" });
    button.addEventListener("click", () => choose({ button,
      where: (panel) => row.element.after(make("tr", { class: "times" }, make("td", { colspan: columns.length + 2 }, panel))),
      data: () => { const it = find(); return it && timesOf(it, index + 1); } }));
    return button;
  });
  const name = make("th", { scope: "row" });
  const cells = counts.map((button) => make("td", {}, button)), last = make("td");
  const row = { label, name, counts, cells, last, element: make("tr", {}, name, ...cells, last) };
  return row;
}

// The last row of a table, in place of those of classes that did not sound.
function beginZero(columns) {
  const button = make("button", { type: "button", class: "quiet zero", "aria-expanded": "false" });
  button.addEventListener("click", () => {
    set(button, "aria-expanded", String(button.getAttribute("aria-expanded") !== "true"));
    drawAgain();
  });
  return { button, element: make("tr", {}, make("td", { colspan: columns.length + 2 }, button)) };
}

function showZero({ zero, rows, lanes }) {
  const none = lanes.map(({ counts, bars, pale }) => !bars && !pale && counts.every((value) => value === 0));
  const isFolded = zero.button.getAttribute("aria-expanded") !== "true";
  rows.forEach(({ element, counts }, index) => {
    element.hidden = isFolded && none[index] && !counts.includes(open?.button);
  });
  const named = lanes.filter(({ label }, index) => none[index] && label !== "unknown");
  const texts = [["zero", false], ["zero perhaps", true]].map(([key, isPerhaps]) => {
    const names = named.filter(({ perhaps }) => perhaps === isPerhaps).map(({ words }) => inside(words));
    return names.length ? say(key, { classes: names.join(", ") }) : "";
  }).filter(Boolean);
  write(zero.button, texts.join(". "));
  zero.element.hidden = !texts.length;
}

function showRow(row, it, where, { columns, now }) {
  const isPast = now === null;
  if (!row.name.firstChild) {
    row.name.append(make("span", { class: "with-swatch" }, swatch(it.colour),
      make("span", {}, breakable(it.words), row.comma = make("span", { class: "hidden" }), row.about = make("span", { class: "about", "aria-hidden": "true" }))));
  }
  const note = it.uncounted ? count("uncounted", it.uncounted) : "";
  write(row.comma, note && `, ${count("uncounted in words", it.uncounted)}`); // for a screen reader
  write(row.about, note);
  it.counts.forEach((value, index) => {
    row.cells[index].className = value ? "" : "none";
    write(row.counts[index], value === null ? say("not known") : counted(value, it.unsure[index + 1]));
    const name = [it.words, where, columns[index]].filter(Boolean).join(", ");
    set(row.counts[index], "aria-label", `${name}: ${value === null ? say("not known") : spoken(value, it.unsure[index + 1])}`);
  });
  row.last.className = it.last ? "" : "none";
  write(row.last, it.last || say(isPast || it.uncounted ? "none in span" : "not lately"));
}

function beginRoom(name, isAlone) {
  const room = { name, lanes: [], sounded: [], drawn: [], rows: [], where: isAlone ? "" : name };
  room.nights = draw("path", { class: "shade" });
  room.unheard = draw("path", { fill: "url(#unheard)" });
  room.future = draw("path", { class: "future" });
  room.hourLines = draw("path", { class: "line" });
  room.moment = draw("path", { class: "moment" });
  room.hours = draw("g", { class: "hours", "aria-hidden": "true" });
  room.group = draw("g");
  room.ground = draw("path", { class: "ground" });
  room.plot = draw("g", {}, room.ground, room.nights, room.unheard,
    room.future, room.hourLines, room.moment, room.group, room.hours); // marks lie over the line of now
  room.svg = draw("svg", { class: "picture", role: "group" }, room.plot);
  room.heads = make("tr");
  room.body = make("tbody");
  room.table = make("table", { "aria-label": isAlone ? say("often") : say("often in", { room: name }) },
    make("thead", {}, room.heads), room.body);
  room.note = make("p", { class: "note" });
  const heading = () => isAlone ? [] : [make("h3", {}, name)];
  room.pictures = [...heading(), room.svg, room.note];
  room.tables = [...heading(), room.table];
  return room;
}

// Writes the names and counts of the lanes; returns how much room they take left of the picture.
function showNames({ svg, sounded, drawn }, full) {
  const isApart = innerWidth >= WIDE, most = MOST_NAME * full;
  svg.classList.toggle("apart", isApart);
  let widest = 0;
  sounded.forEach((it, number) => {
    const { name, figure } = drawn[number];
    write(name, it.words);
    write(figure, figureOf(it));
    if (!isApart) return;
    for (const text of [name, figure]) {
      for (let end = text.textContent.length - 1; end > 1 && text.getComputedTextLength() > most; end -= 1) {
        text.textContent = `${text.textContent.slice(0, end)}…`;
      }
      widest = Math.max(widest, text.getComputedTextLength());
    }
  });
  return isApart && widest ? Math.ceil(widest) + 10 : 0;
}

function showRoom(room, { gaps, unheard, lanes }, day) {
  room.lanes = lanes;
  room.sounded = lanes.filter(({ bars, pale }) => bars || pale);
  const full = Math.max(Math.floor(room.svg.getBoundingClientRect().width), 100);
  while (room.drawn.length < room.sounded.length) {
    const lane = beginLane(room, room.drawn.length);
    room.drawn.push(lane);
    room.group.append(lane.element);
  }
  while (room.drawn.length > room.sounded.length) room.drawn.pop().element.remove();
  const left = showNames(room, full), width = full - left;
  const tall = left ? LANE : NAME + STRIP + GAP, head = left ? GAP : NAME, strip = left ? LANE - 2 * GAP : STRIP;
  const height = Math.max(room.sounded.length, 1) * tall, whole = height + HOURS;
  const bands = left || !room.sounded.length ? [[0, height]] : room.sounded.map((_, number) => [number * tall + head, strip]);
  set(room.plot, "transform", `translate(${left} 0)`);
  set(room.svg, "viewBox", `0 0 ${full} ${whole}`);
  set(room.svg, "height", whole);
  set(room.svg, "aria-label", say("picture", { day: [room.where, day.title].filter(Boolean).join(", ") }));
  set(room.ground, "d", spans([[0, 1]], width, bands));
  set(room.nights, "d", spans(day.nights, width, bands));
  set(room.unheard, "d", spans(gaps, width, bands));
  set(room.future, "d", day.now === null ? "" : spans([[day.now, 1]], width, bands));
  set(room.moment, "d", day.now === null ? "" : lines([day.now], width, bands));
  room.sounded.forEach((it, number) => {
    const lane = room.drawn[number], top = number * tall;
    set(lane.element, "aria-label", it.told);
    for (const [name, value] of [["x", -left], ["y", top], ["width", full], ["height", tall]]) set(lane.hit, name, value);
    set(lane.line, "d", number && left ? `M${-left} ${top}H${width}` : "");
    if (open?.button === lane.element && lane.label !== it.label) close(); // its times would be those of another class
    lane.label = it.label;
    showMarks(lane.marks, it, width, day.hours.length, top + head, strip);
    const places = left ? [[lane.name, -left, 15], [lane.figure, -left, 30]] : [[lane.name, 0, 13], [lane.figure, width, 13]];
    for (const [text, x, y] of places) { set(text, "x", x); set(text, "y", top + y); }
  });
  const every = width < 420 ? 4 : 2, written = day.hours.filter(([, hour]) => hour % every === 0);
  set(room.hourLines, "d", lines(written.map(([where]) => where).filter(Boolean), width, bands));
  room.hours.replaceChildren(...written.map(([where, hour]) =>
    draw("text", { x: Math.min(Math.max(where * width, 8), width - 8), y: height + 14 }, String(hour).padStart(2, "0"))));
  write(room.note, [room.sounded.length ? "" : say("nothing"), unheard].filter(Boolean).join(" "));
  room.note.hidden = !room.note.textContent;
  showTable(room, day);
  if (open && !open.button.isConnected) close();
}

function showTable(room, day) {
  keep(room.heads, [say("sound"), ...day.columns, say("last")], () => make("th", { scope: "col" }), write);
  room.table.hidden = !room.lanes.length;
  const key = JSON.stringify([day.columns.length, room.lanes.map(({ label, words }) => [label, words])]);
  if (room.key !== key) { // else what somebody reads there stays
    room.key = key;
    room.rows = room.lanes.map(({ label }) => beginRow(room, label, day.columns));
    room.zero = beginZero(day.columns);
    room.body.replaceChildren(...room.rows.map(({ element }) => element), room.zero.element);
  }
  room.rows.forEach((row, index) => showRow(row, room.lanes[index], room.where, day));
  showZero(room);
}

// What the signs in the table mean.
function showKey(lanes) {
  const key = [["key unsure", lanes.some(({ unsure }) => unsure.some(Boolean))], ["key uncounted", lanes.some(({ uncounted }) => uncounted)]];
  write(place("counts-key"), key.filter(([, isThere]) => isThere).map(([each]) => say(each)).join(" · "));
  place("counts-key").hidden = !place("counts-key").textContent;
}

let rooms = [], roomsOf = "", shown = null;

export function showDay(day) {
  const isNew = shown?.date !== day.date;
  shown = day;
  if (isNew) close();
  place("legend").hidden = place("counts").hidden = !day.rooms.length;
  write(place("missing"), day.missing);
  place("missing").hidden = !day.missing;
  place("key-unheard").hidden = !day.rooms.some(({ gaps }) => gaps.length);
  place("key-unsure").hidden = !day.rooms.some(({ lanes }) => lanes.some((lane) => lane.unsure_bars));
  place("key-beside").hidden = !day.rooms.some(({ lanes }) => lanes.some(({ pale }) => pale));
  showKey(day.rooms.flatMap(({ lanes }) => lanes));
  const key = JSON.stringify(day.rooms.map(({ room }) => room));
  if (key !== roomsOf) {
    close();
    roomsOf = key;
    rooms = day.rooms.map(({ room }) => beginRoom(room, day.rooms.length === 1));
    place("rooms").replaceChildren(...rooms.flatMap(({ pictures }) => pictures));
    place("tables").replaceChildren(...rooms.flatMap(({ tables }) => tables));
  }
  day.rooms.forEach((room, index) => showRoom(rooms[index], room, day));
  if (open) showTimes();
}

export function drawAgain() {
  if (shown) showDay(shown);
}
