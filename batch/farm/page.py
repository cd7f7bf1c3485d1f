# SPDX-License-Identifier: GPL-3.0-or-later
"""``summary.html``: one page without scripts or anything from elsewhere, light or dark as the reader's screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from urllib.parse import quote

from .summary import GOOD, STATES, Summary, VariantSummary
from .task import Outcome, Task

REFRESH_S = 10
MOST_ROWS = 3000
"""A longer table of tasks shows what has not ended well; summary.json has all."""

MOST_FAILURES = 50

LogEnd = Callable[[Task], str]
"""The end of a task's log."""

_STYLE = """
:root { color-scheme: light dark; --page: #f6f6f4; --card: #ffffff; --text: #1d1f21; --dim: #686e75; --line: #dfe1e3;
  --done: #2f8f5b; --kept: #7fb89a; --running: #3577c9; --waiting: #c9cdd2; --failed: #c8402f; --skipped: #d79a34;
  --cancelled: #98868f; }
@media (prefers-color-scheme: dark) { :root { --page: #17191b; --card: #212427; --text: #e6e7e8; --dim: #9aa1a8;
  --line: #34383c; --done: #4fb57d; --kept: #3f7658; --running: #5f9fe8; --waiting: #42474d; --failed: #ea6b5a;
  --skipped: #c98f35; --cancelled: #84737c; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 2rem 1.5rem 4rem; background: var(--page); color: var(--text);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { margin: 0; font-size: 1.7rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { margin: 2.2rem 0 .7rem; font-size: 1.1rem; }
p { margin: .3rem 0; } .dim { color: var(--dim); } a { color: inherit; text-underline-offset: 2px; }
.bar { display: flex; height: 10px; margin: 1rem 0 .5rem; border-radius: 5px; overflow: hidden;
  background: var(--line); }
.bar i { display: block; } .legend { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; padding: 0; margin: 0; }
.legend li { list-style: none; } .dot { display: inline-block; width: .65em; height: .65em; border-radius: 50%;
  margin-right: .4em; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 .8rem;
  overflow: hidden; }
.card > div { padding: .6rem .9rem .7rem; } .card h3 { margin: 0; font-size: 1rem; overflow-wrap: anywhere; }
.strip { display: block; width: 100%; height: auto; max-height: 132px; object-fit: cover; object-position: left;
  background: var(--line); }
.head { display: flex; flex-wrap: wrap; align-items: baseline; gap: .1rem .9rem; } .head .right { margin-left: auto; }
pre { margin: .5rem 0 0; padding: .6rem .8rem; background: var(--page); border-radius: 6px; max-height: 18rem;
  overflow: auto; font: 12px/1.45 ui-monospace, monospace; white-space: pre-wrap; overflow-wrap: anywhere; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; } .scroll { overflow-x: auto; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--dim); white-space: nowrap; } td.n, th.n { text-align: right; white-space: nowrap; }
td.id { overflow-wrap: anywhere; min-width: 14rem; } summary { cursor: pointer; }
"""


def summary_page(summary: Summary, log_end: LogEnd, log_name: Callable[[Task], str]) -> str:
    """The page. log_end: what to quote of a log; log_name: its file, relative to the page."""
    running = summary.state == "running"
    refresh = f'<meta http-equiv="refresh" content="{REFRESH_S}">' if running else ""
    failures = [(task, outcome) for task, outcome in summary.tasks if outcome.state == "failed"]
    parts = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">{refresh}',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(summary.job)}: {summary.state}</title><style>{_STYLE}</style></head><body>",
        _head(summary),
        _failures(failures, log_end, log_name),
        f"<h2>{_count(len(summary.variants), 'variant')}</h2>",
        *(_variant(variant) for variant in summary.variants),
        _stages(summary),
        _tasks(summary.tasks, log_name),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def duration(seconds: float) -> str:
    """Seconds for people: ``0.4 s``, ``12 s``, ``3:20 min``, ``5:02 h``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


def _state(state: str) -> str:
    return f'<span class="dot" style="background:var(--{state})"></span>{state}'


def _head(summary: Summary) -> str:
    total = max(1, len(summary.tasks))
    bar = "".join(
        f'<i style="width:{100 * summary.counts[s] / total:.3f}%;background:var(--{s})"></i>'
        for s in STATES
        if summary.counts[s]
    )
    legend = "".join(f"<li>{_state(s)} {summary.counts[s]}</li>" for s in STATES if summary.counts[s])
    facts = [
        _WORDS[summary.state],
        _count(len(summary.tasks), "task"),
        f"{duration(summary.seconds)}, {duration(sum(stage.cpu_seconds for stage in summary.stages))} of CPU time",
        f"begun {summary.started[:16].replace('T', ' ')} UTC",
        f"PhysGen {summary.version}",
    ]
    return (
        f'<h1>{escape(summary.job)}</h1><p class="dim">{escape(" · ".join(facts))}</p>'
        f'<div class="bar">{bar}</div><ul class="legend">{legend}</ul>'
    )


_WORDS = {"running": "running", "done": "all done", "failed": "ended with failures", "cancelled": "stopped"}


def _failures(failures: Sequence[tuple[Task, Outcome]], log_end: LogEnd, log_name: Callable[[Task], str]) -> str:
    if not failures:
        return ""
    parts = [f"<h2>{_count(len(failures), 'failure')}</h2>"]
    for task, outcome in failures[:MOST_FAILURES]:
        words = log_end(task)
        log = f'<pre>{escape(words)}</pre><p><a href="{quote(log_name(task))}">whole log</a></p>' if words else ""
        parts.append(
            f'<section class="card"><div><div class="head"><h3>{escape(task.id)}</h3>'
            f'<span class="dim">code {outcome.exit_code} · {_count(outcome.attempts, "attempt")} · '
            f"{escape(outcome.worker)}</span></div><p>{escape(outcome.message)}</p>{log}</div></section>"
        )
    if len(failures) > MOST_FAILURES:
        parts.append(f'<p class="dim">{len(failures) - MOST_FAILURES} more are in summary.json</p>')
    return "\n".join(parts)


def _variant(variant: VariantSummary) -> str:
    picture = ""
    if variant.strip is not None:
        picture = (
            f'<img class="strip" loading="lazy" src="{quote(variant.strip)}" alt="frames of {escape(variant.id)}">'
        )
        if variant.results:
            picture = f'<a href="{quote(variant.results[0])}">{picture}</a>'
    links = " ".join(f'<a href="{quote(r)}">{escape(r.rpartition("/")[2])}</a>' for r in variant.results)
    progress = "" if variant.finished == variant.tasks else f" {variant.finished}/{variant.tasks}"
    return (
        f'<section class="card">{picture}<div><div class="head"><h3>{escape(variant.id)}</h3>'
        f'<span>{_state(variant.state)}{progress}</span><span class="right">{links} '
        f'<span class="dim">{duration(variant.cpu_seconds)} CPU</span></span></div>'
        f'<p class="dim">{escape(variant.meaning)}</p></div></section>'
    )


def _stages(summary: Summary) -> str:
    rows = "".join(
        f"<tr><td>{s.stage}</td><td class=n>{s.finished} of {s.tasks}</td><td class=n>{duration(s.seconds)}</td>"
        f"<td class=n>{duration(s.cpu_seconds)}</td><td class=n>{duration(s.slowest)}</td></tr>"
        for s in summary.stages
        if s.tasks
    )
    return (
        "<h2>Time of this run</h2><div class=scroll><table><tr><th>stage</th><th class=n>finished</th>"
        f"<th class=n>time</th><th class=n>CPU</th><th class=n>slowest</th></tr>{rows}</table></div>"
    )


def _tasks(tasks: Sequence[tuple[Task, Outcome]], log_name: Callable[[Task], str]) -> str:
    shown = tasks if len(tasks) <= MOST_ROWS else [item for item in tasks if item[1].state not in GOOD][:MOST_ROWS]
    rows = "".join(
        f"<tr><td class=id>{_id(task, outcome, log_name)}</td><td>{_state(outcome.state)}</td>"
        f"<td class=n>{duration(outcome.seconds)}</td><td class=n>{duration(outcome.cpu_seconds)}</td>"
        f"<td class=n>{outcome.attempts}</td><td>{escape(outcome.worker)}</td></tr>"
        for task, outcome in shown
    )
    left = (
        f'<p class="dim">{len(shown)} of {len(tasks)}; all are in summary.json</p>' if len(shown) < len(tasks) else ""
    )
    return (
        f"<h2>Tasks</h2><details><summary>{_count(len(tasks), 'task')}</summary>{left}<div class=scroll><table>"
        "<tr><th>task</th><th>state</th><th class=n>time</th><th class=n>CPU</th><th class=n>attempts</th>"
        f"<th>worker</th></tr>{rows}</table></div></details>"
    )


def _id(task: Task, outcome: Outcome, log_name: Callable[[Task], str]) -> str:
    began = outcome.attempts > 0 or outcome.state in GOOD
    return f'<a href="{quote(log_name(task))}">{escape(task.id)}</a>' if began else escape(task.id)
