"""C self-test of a compiled policy: the bundle's golden vectors, within the contract's tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.export.compiled.interface import Interface
from rlservo.export.compiled.names import C_TYPES, array_text, string


def self_test_text(
    face: Interface,
    inputs: Mapping[str, NDArray[Any]],
    outputs: Mapping[str, NDArray[Any]],
    allowed: Mapping[str, NDArray[np.float64]],
    refused: NDArray[np.bool_],
) -> str:
    """Return a program that exits with 0 if every recorded output is reproduced.

    `allowed` is the difference that each element of each output may have, and `refused` says which vectors have an
    action that must not leave: `[vectors]`.
    """
    p, u = face.prefix, face.upper
    count = len(refused)
    given = [("obs", m, m.tensor) for m in face.obs] + [("state", m, f"state_in.{m.tensor}") for m in face.state]
    wanted = [("action", m, m.tensor) for m in face.action] + [
        ("state", m, f"state_out.{m.tensor}") for m in face.state
    ]
    tables = [_table("given", s, m.name, inputs[t]) for s, m, t in given]
    tables += [_table("wanted", s, m.name, outputs[t]) for s, m, t in wanted]
    tables += [_table("allowed", s, m.name, _rounded_up(allowed[t])) for s, m, t in wanted]
    tables.append(_table("refused", "action", "", refused.astype(np.uint8)))
    copies = "\n".join(
        f"        memcpy({s}.{m.name}, given_{s}_{m.name}[v], sizeof {s}.{m.name});" for s, m, _ in given
    )
    compares = "\n".join(
        f"        for (int i = 0; i < {m.size}; i++)\n            compare({string(t)}, v, i, (double){s}.{m.name}[i], "
        f"(double)wanted_{s}_{m.name}[v][i],\n                    (double)allowed_{s}_{m.name}[v][i]);"
        for s, m, t in wanted
    )
    tiny = "\n".join(
        f"    for (int i = 0; i < {m.size}; i++) obs.{m.name}[i] = 1e-38{'f' if m.dtype == np.float32 else ''};"
        for m in face.obs if m.dtype.kind == "f"
    )  # fmt: skip
    return f"""\
/* Self-test of {p}.c: {count} observations that the exporter recorded, with the outputs that it proved. */
#ifdef MEASURE /* with clock_gettime: print what `step_us` of compile.json has, in nanoseconds, too */
#define _POSIX_C_SOURCE 199309L
#endif
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "{p}.h"

{chr(10).join(tables)}

static int failures = 0;
static double largest = 0.0;

static void compare(const char *what, int vector, int element, double got, double expected, double allowed) {{
    const double difference = got > expected ? got - expected : expected - got;
    if (difference > largest) largest = difference;
    if (difference <= allowed || got == expected) return;
    if (failures++ < 10)
        printf("vector %d, %s, element %d: %.9g, expected %.9g, allowed difference %.3g\\n", vector, what, element, got,
               expected, allowed);
}}

#ifdef MEASURE
#define STEPS (20000 / {count + 1})
static double times[{count + 1} * STEPS];

static int ascending(const void *a, const void *b) {{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}}

static void measure(double *taken, const {p}_obs *obs, {p}_state *state, {p}_action *action) {{
    for (int step = 0; step < STEPS; step++) {{
        struct timespec before, after;
        clock_gettime(CLOCK_MONOTONIC, &before);
        {p}_act(obs, state, action);
        clock_gettime(CLOCK_MONOTONIC, &after);
        taken[step] = (double)(after.tv_sec - before.tv_sec) * 1e9 + (double)(after.tv_nsec - before.tv_nsec);
    }}
}}

static void report(void) {{
    const int count = {count + 1} * STEPS;
    double slowest = 0;
    for (double *part = times; part < times + count; part += STEPS) {{
        qsort(part, STEPS, sizeof part[0], ascending);
        if (part[STEPS / 2] > slowest) slowest = part[STEPS / 2];
    }}
    qsort(times, (size_t)count, sizeof times[0], ascending);
    printf("nanoseconds: %.0f %.0f %.0f %.0f\\n", times[count / 2], times[count / 100 * 99], times[count - 1], slowest);
}}
#endif

int main(void) {{
    static {p}_obs obs;
    static {p}_state state;
    static {p}_action action;
    for (int v = 0; v < {count}; v++) {{
        int32_t code;
        {p}_reset(&state);
{copies}
#ifdef MEASURE
        measure(times + v * STEPS, &obs, &state, &action);
        {p}_reset(&state);
{copies}
#endif
        code = {p}_act(&obs, &state, &action);
        if (({u}_REFUSED(code) ? 1 : 0) != refused_action[v][0]) {{
            printf("vector %d: result %d (%s)\\n", v, (int){u}_KIND(code), {p}_element(code));
            failures++;
        }}
        if ({u}_REFUSED(code)) continue;
{compares}
    }}
    printf("{p}: %d of {count} vectors, largest difference %.3g: %s\\n", {count}, largest,
           failures ? "FAILED" : "reproduced");
#ifdef MEASURE
{tiny}
    measure(times + {count} * STEPS, &obs, &state, &action);
    report();
#endif
    return failures ? 1 : 0;
}}
"""


def _rounded_up(allowed: NDArray[np.float64]) -> NDArray[np.float32]:
    rounded: NDArray[np.float32] = np.nextafter(allowed.astype(np.float32), np.float32(np.inf))
    return rounded


def _table(what: str, struct: str, name: str, array: NDArray[Any]) -> str:
    rows = array.reshape(len(array), -1)
    text = ",\n".join(f"    {{\n{array_text(row, '        ')}\n    }}" for row in rows)
    stem = "_".join(part for part in (what, struct, name) if part)
    return f"static const {C_TYPES[array.dtype.name]} {stem}[{len(rows)}][{rows.shape[1]}] = {{\n{text}\n}};"
