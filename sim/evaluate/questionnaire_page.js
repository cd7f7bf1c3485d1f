// SPDX-License-Identifier: MIT
// The answers live in the fragment of the address, which no server ever sees and every browser keeps for local files.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (name) => document.getElementById(name);
const CODE = /^[A-Za-z0-9_-]{1,40}$/;

function readState() {
  try {
    const given = JSON.parse(atob(location.hash.slice(1).replace(/-/g, "+").replace(/_/g, "/")));
    if (given.q !== data.questionnaire || !CODE.test(given.p) || !Number.isInteger(given.s)) return null;
    const answers = {};
    for (const [name, videos] of Object.entries(data.cases)) {
      answers[name] = {};
      for (const video of videos) {
        const old = (given.a || {})[name]?.[video];
        answers[name][video] = data.criteria.map((_, i) => {
          const value = Array.isArray(old) ? old[i] : 0;
          return Number.isInteger(value) && value >= 1 && value <= 5 ? value : 0;
        });
      }
    }
    return { q: given.q, p: given.p, s: given.s >>> 0, a: answers };
  } catch {
    return null;
  }
}

const encoded = (state) => "#" + btoa(JSON.stringify(state)).replace(/\+/g, "-").replace(/\//g, "_").replace(/=+$/, "");

function open(page, state) {
  location.href = data.pages[page] + encoded(state);
}

// Order of a case's videos for this person: mulberry32 from the person's number and the case.
function shuffled(items, seed, name) {
  let a = seed;
  for (const letter of name) a = (Math.imul(a, 31) + letter.charCodeAt(0)) >>> 0;
  const random = () => {
    a = (a + 0x6d2b79f5) >>> 0;
    let t = Math.imul(a ^ (a >>> 15), a | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
  const order = [...items];
  for (let i = order.length - 1; i > 0; i--) {
    const j = Math.floor(random() * (i + 1));
    [order[i], order[j]] = [order[j], order[i]];
  }
  return order;
}

function missingOf(state, name) {
  return Object.values(state.a[name]).flat().filter((value) => value === 0).length;
}

function answersFile(state) {
  const cases = {};
  for (const [name, videos] of Object.entries(data.cases)) {
    const scores = {};
    for (const video of videos) {
      const given = state.a[name][video].map((value, i) => [data.criteria[i], value]).filter(([, value]) => value > 0);
      scores[video] = Object.fromEntries(given);
    }
    cases[name] = { order: shuffled(videos, state.s, name), scores };
  }
  return {
    format: data.format,
    version: 1,
    questionnaire: data.questionnaire,
    person: state.p,
    saved: new Date().toISOString(),
    cases,
  };
}

function save(state) {
  const text = JSON.stringify(answersFile(state), null, 1);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = `answers_${state.p}.json`;
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

function startPage() {
  const state = readState();
  const person = byId("person");
  const numbers = crypto.getRandomValues(new Uint32Array(2));
  person.value = state ? state.p : numbers[0].toString(16).padStart(8, "0");
  byId("begin").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!CODE.test(person.value)) return;
    open(1, { q: data.questionnaire, p: person.value, s: state ? state.s : numbers[1], a: state ? state.a : {} });
  });
}

function casePage(state) {
  const last = data.page === data.pages.length - 1;
  const name = Object.keys(data.cases)[data.page - 1];
  const videos = byId("videos");
  shuffled(data.cases[name], state.s, name).forEach((video, i) => {
    const card = videos.querySelector(`[data-video="${video}"]`);
    card.querySelector("h2").textContent = `Video ${i + 1}`;
    card.querySelector("video").setAttribute("aria-label", `Video ${i + 1}`);
    videos.append(card);
  });
  const rows = [...videos.querySelectorAll(".row")];
  const place = (row) => [row.closest("[data-video]").dataset.video, data.criteria.indexOf(row.dataset.criterion)];
  const answerOf = (row) => state.a[name][place(row)[0]][place(row)[1]];

  function show() {
    for (const row of rows) {
      row.classList.toggle("done", answerOf(row) > 0);
      if (answerOf(row) > 0) row.classList.remove("missing");
    }
    const all = rows.length;
    byId("progress").textContent = `Case ${data.page} of ${data.pages.length - 1}: ${all - missingOf(state, name)} of ${all} answered`;
    history.replaceState(null, "", encoded(state));
  }

  function say(text, good) {
    byId("said").hidden = !text;
    byId("said").className = good ? "good" : "";
    byId("said").textContent = text;
  }

  function focusRow(row) {
    (row.querySelector("input:checked") || row.querySelector("input")).focus({ preventScroll: true });
    row.scrollIntoView({ block: "nearest" });
  }

  for (const row of rows) {
    for (const input of row.querySelectorAll("input")) {
      input.checked = Number(input.value) === answerOf(row);
      input.addEventListener("change", () => {
        const [video, criterion] = place(row);
        state.a[name][video][criterion] = Number(input.value);
        say("");
        show();
      });
    }
  }

  function goOn() {
    const open_rows = rows.filter((row) => answerOf(row) === 0);
    if (open_rows.length && !byId("said").dataset.warned) {
      for (const row of open_rows) row.classList.add("missing");
      focusRow(open_rows[0]);
      byId("said").dataset.warned = "yes";
      say(`${open_rows.length} answers are missing here. Press again to go on without them.`);
      return;
    }
    if (!last) {
      open(data.page + 1, state);
      return;
    }
    const lacking = Object.keys(data.cases).filter((other) => missingOf(state, other) > 0);
    save(state);
    const numbers = lacking.map((other) => Object.keys(data.cases).indexOf(other) + 1).join(", ");
    say(
      `Saved as answers_${state.p}.json: please pass this file on.` +
        (lacking.length ? ` Answers are missing in case ${numbers}; go back, add them and save again if you like.` : " Thank you!"),
      true,
    );
  }

  byId("next").addEventListener("click", goOn);
  byId("back").addEventListener("click", () => open(data.page - 1, state));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const active = document.activeElement;
    if (event.key >= "1" && event.key <= "5" && event.key.length === 1) {
      const row = active?.closest(".row") || rows.find((other) => answerOf(other) === 0) || rows[0];
      const input = row.querySelector(`input[value="${event.key}"]`);
      input.checked = true;
      input.dispatchEvent(new Event("change"));
      const after = rows[rows.indexOf(row) + 1];
      if (after) focusRow(after);
      else byId("next").focus();
      event.preventDefault();
    } else if (event.key === "p" || event.key === "P") {
      const video = (active?.closest("article") || videos.firstElementChild).querySelector("video");
      if (video.paused) video.play();
      else video.pause();
      event.preventDefault();
    } else if (event.key === "Enter" && active?.type === "radio") {
      goOn();
      event.preventDefault();
    }
  });
  show();
}

if (data.page === 0) {
  startPage();
} else {
  const state = readState();
  if (state) casePage(state);
  else location.replace(data.pages[0]);
}
