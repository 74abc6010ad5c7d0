// The page of the home: what sounds now, what works, days, and the stream of news.
import { ask, count, counted, draw, inside, keep, make, place, say, send, set, swatch, write } from "./elements.js";
import { beginMarks, drawAgain, showDay, showMarks, spans } from "./picture.js";
import { allowSound, showEvents, showRecurring, showSoundsOf } from "./sounds.js";

const STALE = 20000, AGAIN = 10000, DAYS = 3600000; // milliseconds
const LEVELS = ["well", "warning", "wrong"], SIGNS = ["✓", "!", "✕"];

function showNow({ nothing, rooms }) {
  const sentences = rooms.length ? rooms.map(({ sentence }) => sentence) : [nothing];
  keep(place("heard"), sentences, () => make("span"), (child, text) => write(child, `${text} `));
  keep(place("levels"), rooms.filter(({ level }) => level), () => {
    const bar = make("div", { class: "bar", role: "meter", "aria-valuemin": 0, "aria-valuemax": 100 },
      make("span"));
    return make("div", { class: "level" }, make("span"), bar, make("span", { class: "figure" }));
  }, (child, { room, level: [share, words] }) => {
    const name = room ? say("loudness of", { room }) : say("loudness");
    write(child.children[0], room || name);
    const bar = child.children[1];
    set(bar, "aria-label", name);
    set(bar, "aria-valuenow", Math.round(100 * share));
    set(bar, "aria-valuetext", words);
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

function showHealth(lines) {
  keep(place("health"), lines, () => make("li", {}, make("span", { class: "state" }), " ", make("span")),
    (child, { what, level, text }) => {
      child.className = LEVELS[level];
      write(child.firstElementChild, `${SIGNS[level]} ${what}: ${say(`state.${level}`)}`);
      write(child.lastElementChild, text ? `(${text})` : "");
    });
  const wrong = lines.filter(({ level }) => level > 0).map(({ what }) => what);
  const working = place("working");
  working.className = LEVELS[Math.max(0, ...lines.map(({ level }) => level))];
  write(place("attention"), wrong.length ? say("attention", { things: wrong.join(", ") }) : say("well"));
  working.hidden = false;
}

let clock = "";

function showHome(home) {
  clock = home.clock;
  write(place("home"), home.home);
  write(place("clock"), clock);
  if (document.title !== home.home) document.title = home.home;
  allowSound(home.sound);
  showPause(home.pause);
}

let isPaused = false;

function showPause(text) {
  isPaused = Boolean(text);
  write(place("paused"), text);
  write(place("pause"), say(isPaused ? "resume" : "pause"));
}

place("pause").addEventListener("click", async () => {
  const { said, error } = await send("pause", { pause: isPaused ? "" : "hour", label: "" });
  if (error) write(place("paused"), error);
  else showPause(said);
});

// Days

let today = null, chosen = "", dates = []; // chosen: the date of a past day; empty for today
const fetched = new Map(); // past days by date, for a while

function showToday(day) {
  const isNext = today?.date !== day.date;
  today = day;
  if (isNext) readDates();
  if (!chosen) showChosen(day);
  document.body.classList.remove("waiting"); // the last part of the first news: now nothing moves
}

function showChosen(day) {
  write(place("date"), chosen ? day.title : say("today"));
  showSentence(day);
  showDay(day);
}

// The sentence of a day keeps its height when it gets shorter: what is below stays where it is.
function showSentence({ date, sentence, more }) {
  const element = place("day-sentence");
  element.style.minHeight = element.dataset.date === date ? `${element.offsetHeight}px` : "";
  element.dataset.date = date;
  element.classList.toggle("long", sentence.length > 80);
  write(element, sentence);
  write(place("more-sentences"), more);
  place("more-sentences").hidden = !more;
}

async function readDates() {
  const found = await ask("days");
  dates = Array.isArray(found) ? found : [];
  if (today && !dates.some(([date]) => date === today.date)) dates.unshift([today.date, today.title, 0]);
  const thisYear = dates.length ? dates[0][2] || dates[1]?.[2] : 0;
  place("dates").replaceChildren(...dates.map(([date, words, year]) =>
    make("option", { value: date }, nameOfDay(date, words, year === thisYear ? 0 : year))));
  showPlaceOfDay();
  showWeek();
}

function nameOfDay(date, words, year) {
  if (date === today?.date) return say("today");
  return year ? `${words} ${year}` : words;
}

function showPlaceOfDay() {
  const date = chosen || today?.date, at = dates.findIndex(([each]) => each === date);
  if (date) place("dates").value = date;
  place("day-before").disabled = at < 0 || at + 1 >= dates.length;
  place("day-after").disabled = at <= 0;
  for (const button of place("week").querySelectorAll("button")) {
    set(button, "aria-current", String(button.dataset.date === date));
  }
}

async function readDay(date) {
  let day = fetched.get(date);
  if (!day) {
    day = await ask(`day?${date}`);
    if (!day.error) fetched.set(date, day);
    if (fetched.size > 14) fetched.delete(fetched.keys().next().value);
    setTimeout(() => fetched.delete(date), AGAIN * 30);
  }
  return day;
}

async function chooseDay(date) {
  showWeekOnly(false);
  chosen = date === today?.date ? "" : date;
  showPlaceOfDay();
  write(place("day-status"), "");
  if (!chosen) {
    showSoundsOf();
    if (today) showChosen(today);
    return;
  }
  const slow = setTimeout(() => write(place("day-status"), say("reading day")), 300);
  const day = await readDay(date);
  clearTimeout(slow);
  if (chosen !== date) return; // another one was chosen meanwhile
  write(place("day-status"), day.error ?? "");
  if (day.error) return;
  showChosen(day);
  showSoundsOf(day.events);
}

function step(by) {
  const at = dates.findIndex(([date]) => date === (chosen || today?.date)) + by;
  if (dates[at]) chooseDay(dates[at][0]);
}

// On a phone, what one is asked about follows the picture; the counts are below it.
const wide = matchMedia("(min-width: 62rem)");

function placeQuestions() {
  const active = document.activeElement, questions = place("looked-at");
  if (wide.matches) place("aside").prepend(questions);
  else place("day").after(questions);
  if (questions.contains(active)) active.focus({ preventScroll: true });
}

wide.addEventListener("change", placeQuestions);
placeQuestions();

// The week alone, until one of its days is chosen.
function showWeekOnly(isWanted) {
  if (place("day").classList.toggle("week-only", isWanted)) return;
  drawAgain(); // what is not shown has no width
}

function openWeek() {
  const week = place("week");
  week.hidden = !week.hidden;
  showWeekOnly(!week.hidden);
  place("date").classList.toggle("hidden", week.hidden); // else the list of days has it
  set(place("show-week"), "aria-expanded", String(!week.hidden));
  write(place("show-week"), say(week.hidden ? "week" : "back"));
  showWeek();
}

async function showWeek() {
  const week = place("week");
  if (week.hidden) return;
  const rows = dates.slice(0, 7).map(([date, words]) => {
    const row = { date, svg: draw("svg", { "aria-hidden": "true", preserveAspectRatio: "none" }),
      about: make("span", { class: "about" }) };
    row.button = make("button", { type: "button", "data-date": date }, make("span", { class: "what" }, date === today?.date ? say("today") : words),
      row.svg, row.about);
    set(row.svg, "height", 1);
    row.button.addEventListener("click", async () => {
      await chooseDay(date);
      place("date").scrollIntoView();
      place("date").focus({ preventScroll: true });
    });
    return row;
  });
  const axis = make("li", { class: "axis", "aria-hidden": "true" }), key = make("li", { class: "note", "aria-hidden": "true" });
  week.replaceChildren(key, ...rows.map((row) => make("li", {}, row.button)), axis);
  showPlaceOfDay();
  const drawn = [];
  for (const row of rows) {
    const day = row.date === today?.date ? today : await readDay(row.date);
    if (week.hidden || !row.button.isConnected) return;
    keep(row.about, day.error ? [day.error] : countsOf(day), () => make("span"), write);
    if (day.error) continue;
    drawn.push([row, day]);
    const classes = classesOf(drawn.map(([, each]) => each));
    const longest = drawn.map(([, each]) => each).reduce((a, b) => (b.hours.length > a.hours.length ? b : a));
    for (const each of drawn) showDayOfWeek(...each, classes, longest.hours.length);
    axis.replaceChildren(...hoursBelow(longest));
    key.replaceChildren(dates.length < 7 ? `${count("days so far", dates.length)} ` : "", `${say("week rows")} `, ...classes.map(([, it]) => make("span", { class: "entry" }, " ", swatch(it.colour), it.words)),
      ...["unsure", "beside"].map((each) => make("span", { class: "entry" }, ` ${say(each)}`)));
  }
}

// The counts of a day by its night and day, so that days can be compared; its sentence if nothing of importance is counted.
function countsOf({ rooms, sentence, television }) {
  const lines = rooms.flatMap(({ room, lanes }) => lanes.filter(({ main, count: all }) => main && all).map(({ words, counts, unsure }) => {
    const parts = counts.map((value, index) => say(`part.${index}`, { count: value === null ? say("not known") : counted(value, unsure[index + 1]) }));
    return say("class and parts", { class: rooms.length > 1 ? `${room}, ${inside(words)}` : words, parts: parts.join(", ") });
  }));
  return [...(lines.length ? lines : [sentence]), ...(lines.length && television ? [`${television}.`] : []), ...rooms.map(({ unheard }) => unheard).filter(Boolean)];
}

// The classes that people ask about and that sounded on some days, by label, in the order of the lanes.
function classesOf(days) {
  const lanes = days.flatMap(({ rooms }) => rooms).flatMap((room) => room.lanes).filter(({ main }) => main);
  const sounded = new Set(lanes.filter(({ bars, pale }) => bars || pale).map(({ label }) => label));
  return [...new Map(lanes.map((lane) => [lane.label, lane]))].filter(([label]) => sounded.has(label));
}

function hoursBelow(day) {
  return day.hours.filter(([, hour]) => hour % 6 === 0).map(([where, hour]) => {
    const text = make("span", {}, String(hour).padStart(2, "0"));
    text.style.left = `${100 * where}%`; // the page allows no attribute of style
    return text;
  });
}

const LANE = 12, GAP = 2; // pixels of a class in a day of the week

function showDayOfWeek(row, day, classes, mostHours) {
  const full = Math.max(Math.floor(row.svg.getBoundingClientRect().width), 100), width = full * day.hours.length / mostHours;
  const height = Math.max(classes.length, 1) * LANE + GAP, bands = [[0, height]];
  set(row.svg, "viewBox", `0 0 ${full} ${height}`);
  set(row.svg, "height", height);
  row.svg.replaceChildren(draw("path", { class: "shade", d: spans(day.nights, width, bands) }),
    ...day.rooms.map(({ gaps }) => draw("path", { fill: "url(#unheard)", d: spans(gaps, width, bands) })),
    draw("path", { class: "future", d: day.now === null ? "" : spans([[day.now, 1]], width, bands) }),
    ...day.rooms.flatMap((room) => room.lanes).flatMap((lane) => {
      const at = classes.findIndex(([label]) => label === lane.label), paths = beginMarks();
      if (at >= 0) showMarks(paths, lane, width, day.hours.length, at * LANE + GAP, LANE - GAP);
      return paths;
    }));
}

place("dates").addEventListener("change", () => chooseDay(place("dates").value));
place("day-before").addEventListener("click", () => step(1));
place("day-after").addEventListener("click", () => step(-1));
place("show-week").addEventListener("click", openWeek);
setInterval(readDates, DAYS);

// The connection to the box

function trouble(text) {
  const element = place("trouble");
  if (text) write(element, text + (clock ? ` ${say("as of", { time: clock })}` : ""));
  element.hidden = !text;
}

let stale = 0;

function beat() {
  trouble("");
  clearTimeout(stale);
  stale = setTimeout(() => trouble(say("stale")), STALE);
}

function connect() {
  const source = new EventSource("events");
  const shows = { home: showHome, now: showNow, scenarios: showScenarios, day: showToday, events: showEvents,
    recurring: showRecurring, health: showHealth };
  for (const [name, show] of Object.entries(shows)) {
    source.addEventListener(name, ({ data }) => show(JSON.parse(data)));
  }
  source.addEventListener("beat", beat);
  source.addEventListener("error", () => {
    if (source.readyState !== EventSource.CLOSED) {
      trouble(say(navigator.onLine ? "no connection" : "offline"));
      return;
    }
    trouble(say("closed"));
    setTimeout(connect, AGAIN);
  });
}

addEventListener("offline", () => trouble(say("offline")));
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth !== width) {
    place("day-sentence").style.minHeight = "";
    drawAgain();
  }
  width = innerWidth;
});
connect();
