// The live page: the newest reading, or an earlier one that the timeline has chosen, drawn once
// for each picture of the screen.
import { Controls } from "./controls.js";
import { admitted } from "./door.js";
import { Sheet } from "./sheet.js";
import { Tasks } from "./tasks.js";
import { Timeline, total } from "./timeline.js";

const SILENT = 2000; // ms without any event after which the server is gone
const LATE = 1000; // ms by which an event may come later than the fastest one
const KEPT = 4096; // delays, for measurements
const REFUSED = 2000; // ms after which a refused browser asks again
const UNKNOWN = "not estimated";
const STATES = ["idle", "touch", "bend"];
const WIDE = "(min-width: 1180px)"; // where the drawer of a virtual board is open at first

const $ = (id) => document.getElementById(id);
const page = { updates: 0, number: null, largest: 0, delays: [] };
window.eitskin = page; // what has been drawn, for measurements

let role = null;
let parts = null;
let newest = null;
let drawn = null;
let heard = performance.now();
let fastest = Infinity;
let waiting = false;
let health = { stale: true, connection: "", age: null };
let replayed = null; // name of the recording that is shown
let past = []; // frames from before this page was opened, until the server's clock is known

function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function signed(value, digits) {
  const size = Math.abs(value).toFixed(digits);
  return Number(size) === 0 ? size : `${value < 0 ? "−" : "+"}${size}`;
}

function build(sensor) {
  if (parts) {
    // A new server may serve another board: begin again rather than mix two.
    if (JSON.stringify(sensor) !== parts.known) location.reload();
    return;
  }
  const known = JSON.stringify(sensor), commands = role === "commander";
  let controls = null;
  const press = commands && sensor.controls && ((touches) => controls.press(touches));
  const sheet = new Sheet($("sensor"), $("map"), $("sheet-note"), sensor, press);
  if (press) controls = new Controls(sensor, sheet);
  parts = {
    known,
    sheet,
    controls,
    labels: sensor.labels,
    tasks: sensor.tasks && new Tasks(commands ? sensor.tasks : [], (place) => sheet.point(place), replay),
    timeline: new Timeline($("timeline"), sensor, travel),
    bars: STATES.map((name) => row(name)),
    numbers: new Map(),
  };
  Object.assign(page, { sheet, timeline: parts.timeline });
  say($("board"), `${sensor.uri} · ${sensor.firmware}`);
  for (const id of ["map-truth", "true-angle"]) $(id).hidden = !sensor.controls;
  $("above").onclick = () => sheet.view.reset(true);
  $("around").onclick = () => sheet.view.reset();
  $("pause").onclick = pause;
  $("newest").onclick = () => replay(null);
  if (press && matchMedia(WIDE).matches) drawer(true);
}

function drawer(open) {
  $("menu").setAttribute("aria-expanded", open);
  document.body.classList.toggle("open", open);
}

$("menu").onclick = () => drawer(!document.body.classList.contains("open"));

function row(name) {
  const item = document.createElement("li"), track = document.createElement("b");
  const bar = track.appendChild(document.createElement("i")), share = document.createElement("output");
  item.append(Object.assign(document.createElement("span"), { textContent: name }), track, share);
  $("probabilities").append(item);
  return { bar, share };
}

function draw(data) {
  const { estimate, stage } = data, truth = stage && stage.truth;
  const unusable = data.problem || "no estimate";
  const known = Boolean(estimate) && estimate.state !== null;
  say($("state"), known ? estimate.state : estimate ? UNKNOWN : unusable);
  $("state").dataset.state = known ? estimate.state : "";
  $("state").classList.toggle("words", !estimate);
  $("state").classList.toggle("unknown", Boolean(estimate) && !known);
  parts.bars.forEach(({ bar, share }, i) => {
    const p = estimate ? estimate.probabilities[i] : null;
    bar.style.transform = `scaleX(${p ?? 0})`;
    say(share, p === null ? "–" : `${(100 * p).toFixed(0)} %`);
  });
  angle(estimate, truth);
  touches(estimate);
  parts.sheet.show(estimate, truth ? truth.touches : [], picture(estimate), parts.timeline.chosen !== null);
  healthLine(data, estimate);
  badChannels(data.bad);
  numbers(data);
  // Channels that the board marked bad have a list of their own.
  const board = new RegExp("^channel (\\S+) is left out: board");
  const others = (estimate ? estimate.problems : []).filter((text) => !((board.exec(text) || [])[1] in data.bad));
  problems(data.problem ? [data.problem, ...others] : others);
}

// --- earlier moments and recordings ---

// Show a moment of the timeline, or the newest again.
function travel(data) {
  const past = data !== null, playing = Boolean(parts.timeline.playing);
  document.body.classList.toggle("past", past);
  say($("pause"), past ? (playing ? "Pause" : "Play") : "Pause");
  $("newest").hidden = !past;
  moment();
  if (past || newest) draw(past ? data : newest);
}

function pause() {
  const line = parts.timeline, [, end] = line.span();
  if (line.playing || line.chosen === null) line.choose(line.chosen === null ? end : line.chosen);
  else line.play();
  say($("pause"), line.playing ? "Pause" : "Play");
}

async function replay(name) {
  replayed = name;
  if (name === null) return parts.timeline.load(null);
  const readings = await parts.tasks.readings(name);
  if (readings && readings.length) parts.timeline.load(readings);
  else replayed = null;
}

function moment() {
  const line = parts.timeline, past = line.chosen === null || !line.source.moments.length ? "" : line.when();
  say($("moment"), [replayed, past, line.words()].filter(Boolean).join(" · "));
}

// The line at the top: green while all is well; else which channels are lost, and the electrode
// whose channels all are.
function healthLine(data, estimate) {
  const lost = Object.keys(data.bad), all = parts.labels;
  const count = (labels, electrode) => labels.filter((label) => label.split(/\D+/).includes(electrode)).length;
  const electrodes = [...new Set(lost.join("-").split(/\D+/))].filter((each) =>
    each && count(lost, each) > 1 && count(lost, each) === count(all, each));
  const names = electrodes.length ? `: electrode ${electrodes.join(", ")} open` : "";
  const others = data.problem ? 1 : estimate ? estimate.problems.length : 0;
  const level = names || data.problem ? "bad" : lost.length || others ? "warn" : "good";
  const text = lost.length ? `${lost.length} of ${all.length} channels lost${names}`
    : others ? (data.problem || estimate.problems[0]) : `${all.length} of ${all.length} channels good`;
  if (document.body.dataset.health !== level) document.body.dataset.health = level;
  say($("health"), text);
}

let named = "";
function badChannels(bad) {
  const kinds = new Map();
  for (const [label, what] of Object.entries(bad)) kinds.set(what, [...(kinds.get(what) || []), label]);
  const names = [...kinds].map(([what, labels]) => `${what}: ${labels.join(", ")}`);
  if (named !== names.join("|")) list($("bad"), names);
  named = names.join("|");
}

function list(element, texts) {
  element.replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

// The picture to show, where one comes with the estimate and is chosen.
function picture(estimate) {
  const made = estimate && estimate.picture;
  $("picture-choice").hidden = !made;
  if (!made) return null;
  say($("picture-scale"), `Image: conductivity, blue −${(100 * made.limit).toPrecision(2)} % to orange +${(100 * made.limit).toPrecision(2)} %`);
  return $("picture").checked ? made : null;
}

function angle(estimate, truth) {
  const value = estimate ? estimate.angle : null;
  say($("angle"), value !== null ? `${signed(value, 1)}°` : estimate ? UNKNOWN : "–");
  $("angle").classList.toggle("unknown", value === null && estimate !== null);
  const deviation = estimate ? estimate.deviation : null;
  say($("deviation"), deviation === null ? "" : `± ${deviation.toFixed(deviation < 0.095 ? 2 : 1)}°`);
  const real = truth ? truth.bend_deg : null;
  const off = real === null || value === null ? "" : `, error ${Math.abs(value - real).toFixed(1)}°`;
  say($("true-angle"), real === null ? "true angle unknown" : `true ${signed(real, 1)}°${off}`);
}

function touches(estimate) {
  const found = estimate ? estimate.touches : [], force = total(estimate);
  say($("total"), !found ? UNKNOWN : found.length && force !== null ? `${force.toFixed(1)} N` : found.length ? `${found.length} ×` : "–");
  $("total").classList.toggle("unknown", !found);
  if (!found) return say($("touches"), "");
  const places = found.map(({ x, y, force, strength }) =>
    `${(1e3 * x).toFixed(0)}, ${(1e3 * y).toFixed(0)} mm:\u00a0${force === null ? strength.toFixed(2) : `${force.toFixed(1)}\u00a0N`}`);
  say($("touches"), places.join("  ·  ") || "no touch");
}

function numbers(data) {
  const dropped = Object.entries(data.dropped).map(([why, count]) => `${count} ${why}`).join(", ");
  number("rate", data.rate === null ? "–" : `${data.rate.toFixed(1)} /s`);
  number("latency", data.latency_ms === null ? "–" : `${data.latency_ms.toFixed(1)} ms`);
  number("end to end", data.begun === null || parts.timeline.chosen !== null ? "–" : `${(performance.now() - fastest - 1000 * data.begun).toFixed(0)} ms`);
  number("frames", data.frames);
  number("lost", data.lost, true);
  number("skipped", data.skipped);
  number("unusable", data.unusable, true);
  number("dropped", dropped || "0", true);
  number("reconnects", data.reconnections, true);
  number("session", data.session);
  number("reference", data.estimate ? data.estimate.zero : "–");
  number("frame", data.number);
}

function number(name, value, worry = false) {
  if (!parts.numbers.has(name)) {
    const group = document.createElement("div"), shown = document.createElement("dd");
    group.append(Object.assign(document.createElement("dt"), { textContent: name }), shown);
    $("numbers").append(group);
    parts.numbers.set(name, { group, shown });
  }
  const { group, shown } = parts.numbers.get(name);
  say(shown, String(value));
  if (worry) group.classList.toggle("nonzero", value !== 0 && value !== "0");
}

let listed = "";
function problems(texts) {
  if (texts.join("|") === listed) return;
  listed = texts.join("|");
  list($("problems"), texts);
}

// What the link is: live, stale (no new frames), or lost (no server).
function judge() {
  const silent = performance.now() - heard;
  let link = "live", text = "live";
  if (silent > SILENT) {
    [link, text] = ["lost", "server gone, waiting for it"];
  } else if (health.late) {
    [link, text] = ["stale", "stale: this browser is behind"];
  } else if (health.connection) {
    [link, text] = ["stale", "no board, connecting again"];
  } else if (health.stale) {
    const since = health.age === null ? "" : ` for ${(health.age + silent / 1000).toFixed(0)} s`;
    [link, text] = health.age === null ? ["connecting", "waiting for the first frame"] : ["stale", `stale: no frame${since}`];
  }
  if (document.body.dataset.link !== link) document.body.dataset.link = link;
  say($("link"), text);
}

// While no frames come, what is known still: why, and the board's scene.
function quiet(data) {
  if (data.connection) problems([data.connection]);
  if (parts.controls && data.stage) parts.controls.show(data.stage);
}

function hear(event) {
  const data = JSON.parse(event.data), before = health.connection;
  page.largest = Math.max(page.largest, event.data.length);
  const last = heard;
  heard = data.heard = performance.now();
  const delay = heard - 1000 * data.sent;
  if (parts) {
    parts.timeline.recall(past.map((each) => ({ time: each.sent + delay / 1000, data: each })));
    past = [];
  }
  // Two clocks drift apart: what was fastest is forgotten, by a tenth of a millisecond a second.
  fastest = Math.min(fastest + 1e-4 * (heard - last), delay);
  if (parts && parts.tasks && data.tasks) parts.tasks.show(data.tasks);
  health = { stale: data.stale, connection: data.connection, age: data.age, late: delay - fastest > LATE };
  if (parts && before !== data.connection) {
    parts.timeline.note(heard / 1000, data.connection ? "bad" : "good", data.connection || "board connected again");
  }
  if (event.type === "frame") newest = data;
  else if (parts) quiet(data);
  if (!waiting) requestAnimationFrame(turn);
  waiting = true;
}

function turn() {
  waiting = false;
  if (parts && newest !== drawn) {
    drawn = newest;
    parts.timeline.add(newest.heard / 1000, newest);
    if (parts.timeline.chosen === null) draw(newest);
    if (parts.controls && newest.stage) parts.controls.show(newest.stage);
    moment();
    page.updates += 1;
    page.number = newest.number;
    if (newest.begun !== null) page.delays.push(performance.now() - fastest - 1000 * newest.begun);
    if (page.delays.length > KEPT) page.delays.shift();
  }
  judge();
}

function follow() {
  const source = new EventSource("/events");
  source.addEventListener("sensor", (event) => {
    fastest = Infinity; // a new connection, maybe of a new server with another clock
    past = [];
    build(JSON.parse(event.data));
  });
  source.addEventListener("past", (event) => {
    if (!newest) past.push(JSON.parse(event.data));
  });
  source.addEventListener("frame", hear);
  source.addEventListener("health", hear);
  // A browser comes back by itself, unless the server refuses it: then there may be a new one with
  // other tokens, or too many watch.
  source.addEventListener("error", () => {
    if (source.readyState === EventSource.CLOSED) setTimeout(begin, REFUSED);
  });
}

async function begin() {
  try {
    role = await admitted();
  } catch {
    setTimeout(begin, REFUSED); // no server, for now
    return;
  }
  follow();
}

begin();
// Silence makes no event, and a hidden tab no pictures.
setInterval(judge, 500);
