// A day as one picture, its counts, and the times behind a lane or a count.
import { breakable, colour, draw, inside, keep, make, place, say, send, set, swatch, write } from "./elements.js";
import { showEntries } from "./sounds.js";

const LANE = 36, NAME = 15, GAP = 3, HOURS = 20; // pixels
const BINS_AN_HOUR = 30;
let open = null; // the lane or count whose times are shown

// Bins of one height in a row are one mark, and the narrowest is seen.
export function marks(bars, width, hours, top, height) {
  const step = width / (hours * BINS_AN_HOUR), foot = top + height;
  let path = "";
  for (let i = 0; i < bars.length;) {
    let end = i + 1;
    while (end < bars.length && bars[end] === bars[i]) end += 1;
    if (bars[i] !== "0") {
      const head = foot - height * (0.2 + 0.8 * bars[i] / 9);
      path += `M${(i * step).toFixed(1)} ${foot}V${head.toFixed(1)}h${
        Math.max((end - i) * step, 3).toFixed(1)}V${foot}Z`;
    }
    i = end;
  }
  return path;
}

export function spans(list, width, height) {
  return list.map(([a, b]) => `M${a * width} 0H${b * width}V${height}H${a * width}Z`).join("");
}

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
  write(open.note, text);
  write(open.hide, say("hide", { class: inside(it.words) }));
}

// A count, those apart that are not sure: 2 (+3?), or 3? if none is sure.
function counted(value, unsure) {
  if (!unsure) return String(value);
  return unsure === value ? `${value}?` : `${value - unsure}\u202F(+${unsure}?)`;
}
const capital = (text) => text[0].toUpperCase() + text.slice(1);
const dayName = () => shown.now === null ? shown.title : say("since evening");

async function hideClass(label) {
  const answer = await send("show", { show: "no", label });
  write(place("hidden-said"), answer.error ?? answer.said);
}

function beginLane(room, number) {
  const name = draw("text", { class: "name" }), figure = draw("text", { class: "count" });
  const lane = { name, figure, marks: draw("path", { class: "marks" }), pale: draw("path", { class: "marks pale" }), line: draw("path", { class: "line" }),
    hit: draw("rect", { class: "hit" }) };
  lane.element = draw("g", { class: "lane", role: "button", tabindex: 0, "aria-expanded": "false" },
    lane.hit, lane.line, lane.pale, lane.marks, name, figure);
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
  const names = lanes.filter((_, index) => none[index]).map(({ words }) => inside(words));
  write(zero.button, say("zero", { classes: names.join(", ") }));
  zero.element.hidden = !names.length;
}

function showRow(row, it, where, columns) {
  if (!row.name.firstChild) row.name.append(make("span", { class: "with-swatch" }, swatch(it.colour), make("span", {}, breakable(it.words))));
  it.counts.forEach((value, index) => {
    row.cells[index].className = value ? "" : "none";
    write(row.counts[index], value === null ? say("not known") : counted(value, it.unsure[index + 1]));
    const name = [it.words, where, columns[index]].filter(Boolean).join(", ");
    set(row.counts[index], "aria-label", `${name}: ${row.counts[index].textContent}`);
  });
  row.last.className = it.last ? "" : "none";
  write(row.last, it.last || say("not lately"));
}

function beginRoom(name, isAlone) {
  const room = { name, lanes: [], sounded: [], drawn: [], rows: [], where: isAlone ? "" : name };
  room.nights = draw("path", { class: "shade" });
  room.unheard = draw("path", { fill: "url(#unheard)" });
  room.future = draw("rect", { class: "future" });
  room.moment = draw("path", { class: "moment" });
  room.hours = draw("g", { class: "hours", "aria-hidden": "true" });
  room.group = draw("g");
  room.ground = draw("rect", { class: "ground", rx: 6 });
  room.svg = draw("svg", { class: "picture", role: "group" }, room.ground, room.nights, room.unheard,
    room.future, room.moment, room.group, room.hours); // the counts lie over the line of now
  room.heads = make("tr");
  room.body = make("tbody");
  room.caption = make("caption", { class: "hidden" });
  room.table = make("table", {}, room.caption, make("thead", {}, room.heads), room.body);
  room.note = make("p", { class: "note" });
  room.elements = [...(isAlone ? [] : [make("h3", {}, name)]), room.svg, room.note, room.table];
  return room;
}

function showRoom(room, { gaps, unheard, lanes }, day) {
  room.lanes = lanes;
  room.sounded = lanes.filter(({ bars, pale }) => bars || pale);
  const width = Math.max(Math.floor(room.svg.getBoundingClientRect().width), 100);
  const height = Math.max(room.sounded.length, 1) * LANE, whole = height + HOURS;
  set(room.svg, "viewBox", `0 0 ${width} ${whole}`);
  set(room.svg, "height", whole);
  set(room.svg, "aria-label", [say("picture", { day: [room.where, day.title].filter(Boolean).join(", ") }), unheard].filter(Boolean).join(" "));
  for (const [name, value] of [["width", width], ["height", height]]) set(room.ground, name, value);
  set(room.nights, "d", spans(day.nights, width, height));
  set(room.unheard, "d", spans(gaps, width, height));
  const now = day.now === null ? 1 : day.now;
  for (const [name, value] of [["x", now * width], ["width", (1 - now) * width], ["height", height]]) {
    set(room.future, name, value);
  }
  set(room.moment, "d", day.now === null ? "" : `M${now * width} 0V${height}`);
  while (room.drawn.length < room.sounded.length) {
    const lane = beginLane(room, room.drawn.length);
    room.drawn.push(lane);
    room.group.append(lane.element);
  }
  while (room.drawn.length > room.sounded.length) room.drawn.pop().element.remove();
  room.sounded.forEach((it, number) => {
    const lane = room.drawn[number], top = number * LANE;
    set(lane.element, "aria-label", it.told);
    for (const [name, value] of [["x", 0], ["y", top], ["width", width], ["height", LANE]]) set(lane.hit, name, value);
    set(lane.line, "d", number ? `M0 ${top}H${width}` : "");
    if (open?.button === lane.element && lane.label !== it.label) close(); // its times would be those of another class
    lane.label = it.label;
    for (const [path, bars] of [[lane.marks, it.bars], [lane.pale, it.pale]]) {
      set(path, "d", marks(bars, width, day.hours.length, top + NAME, LANE - NAME - GAP));
      colour(path, it.colour);
    }
    write(lane.name, it.words);
    write(lane.figure, it.count ? (it.unsure[0] ? counted(it.count, it.unsure[0]) : `${it.count}×`) : "");
    for (const [text, x] of [[lane.name, 6], [lane.figure, width - 6]]) { set(text, "x", x); set(text, "y", top + 12.5); }
  });
  const every = width < 520 ? 4 : 2;
  room.hours.replaceChildren(...day.hours.filter(([, hour]) => hour % every === 0).map(([where, hour]) =>
    draw("text", { x: Math.min(Math.max(where * width, 8), width - 8), y: height + 14 }, String(hour).padStart(2, "0"))));
  write(room.note, room.sounded.length ? "" : say("nothing"));
  room.note.hidden = room.sounded.length > 0;
  showTable(room, day);
  if (open && !open.button.isConnected) close();
}

function showTable(room, day) {
  keep(room.heads, [say("sound"), ...day.columns, say("last")], () => make("th", { scope: "col" }), write);
  write(room.caption, room.where ? say("often in", { room: room.where }) : say("often"));
  room.table.hidden = !room.lanes.length;
  const key = JSON.stringify([day.columns.length, room.lanes.map(({ label, words }) => [label, words])]);
  if (room.key !== key) { // else what somebody reads there stays
    room.key = key;
    room.rows = room.lanes.map(({ label }) => beginRow(room, label, day.columns));
    room.zero = beginZero(day.columns);
    room.body.replaceChildren(...room.rows.map(({ element }) => element), room.zero.element);
  }
  room.rows.forEach((row, index) => showRow(row, room.lanes[index], room.where, day.columns));
  showZero(room);
}

let rooms = [], roomsOf = "", shown = null;

export function showDay(day) {
  const isNew = shown?.date !== day.date;
  shown = day;
  if (isNew) close();
  place("legend").hidden = !day.rooms.length;
  write(place("missing"), day.missing);
  place("missing").hidden = !day.missing;
  place("key-unheard").hidden = !day.rooms.some(({ gaps }) => gaps.length);
  place("key-beside").hidden = !day.rooms.some(({ lanes }) => lanes.some(({ pale }) => pale));
  const key = JSON.stringify(day.rooms.map(({ room }) => room));
  if (key !== roomsOf) {
    close();
    roomsOf = key;
    rooms = day.rooms.map(({ room }) => beginRoom(room, day.rooms.length === 1));
    place("rooms").replaceChildren(...rooms.flatMap(({ elements }) => elements));
  }
  day.rooms.forEach((room, index) => showRoom(rooms[index], room, day));
  if (open) showTimes();
}

export function drawAgain() {
  if (shown) showDay(shown);
}
