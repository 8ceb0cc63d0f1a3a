# ruff: noqa: E501 (templates of sentences are read more easily on one line)
"""Fill the results section of README.md from the JSON files in benchmarks/results/.

    python benchmarks/readme_tables.py [--check]

With --check nothing is written; the exit status says whether the README is what the JSON files say.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from common import RESULTS, ROOT

from torchqm.geometry.files import write_whole

BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"


def joined(files: list[dict[str, Any]]) -> dict[str, Any]:
    """Result files of different classes as one: means over all poses or pairs, each counting once."""
    out = {**files[0], "classes": {c: v for data in files for c, v in data["classes"].items()}}
    out["command"] = "` and `".join(data["command"] for data in files)
    out["all"] = {}
    for figure, rows in files[0]["all"].items():
        out["all"][figure] = {}
        for key in rows:
            cells = [data["all"][figure][key] for data in files]
            n = sum(cell["n_pairs"] for cell in cells)
            mean = sum(cell["n_pairs"] * cell["mean"] for cell in cells) / n
            below = sum(cell["n_pairs"] * cell["share_below"]["0.05"] for cell in cells) / n
            out["all"][figure][key] = {"n_pairs": n, "mean": mean, "share_below": {"0.05": below}}
    return out


def tosca(data: dict[str, Any]) -> str:
    """Figures 6, 8 and 10, one row a class."""
    lines = [
        f"TOSCA, tuning classes, `{data['command']}`: mean geodesic error / sqrt(area) at {data['points_per_shape']} points a",
        "shape (in brackets the share of points below 0.05), means over the poses or pairs counted in the second column. Rows of",
        "the paper use 300 eigenpairs a shape, rows of torchqm 200, as `torchqm match` does unless told otherwise.",
    ]
    figures = [
        ("figure6", "poses", "Figure 6, semi-quotient matching to the undeformed shape, flips forgiven point by point"),
        ("figure8", "poses", "Figure 8, symmetry of each pose"),
        ("figure10", "pairs", "Figure 10, published pairs, a flip of the whole map forgiven"),
    ]
    for figure, what, title in figures:
        columns = [k for k in data["all"][figure] if "landmarks" not in k]
        lines += ["", f"{title}:", "", _row(["class", what, *columns]), _row(["---"] * (len(columns) + 2))]
        rows = {**{c: v[figure] for c, v in data["classes"].items()}, "all": data["all"][figure]}
        for name, cells in rows.items():
            numbers = [f"{cells[k]['mean']:.4f} ({cells[k]['share_below']['0.05']:.2f})" for k in columns]
            lines.append(_row([name, str(cells[columns[0]]["n_pairs"]), *numbers]))
    lines += ["", _notes(data), "", "![Cumulative errors on the published pairs](docs/tosca_figure10.png)"]
    return "\n".join(lines)


def _notes(data: dict[str, Any]) -> str:
    notes = [note for c in data["classes"].values() for note in c["figure10_notes"].values()]
    key = "torchqm, estimated axis"
    right = sum(n[key]["label"] == "direct" and n[key]["element"] == 0 for n in notes)
    plain = sum(n[key]["plain"] for n in notes) / len(notes)
    marks = data["all"]["figure10"]
    below = []
    for name, values in data["classes"].items():
        bim = values["figure10"]["BIM, published"]["mean"]
        ours, theirs = (1 - values["figure10"][f"{k}, estimated axis"]["mean"] / bim for k in ("torchqm", "paper"))
        below.append(f"{name} {ours:.0%} and {theirs:.0%}")
    return (
        f"Below BIM's mean, with the estimated axis, by (torchqm and the paper's way): {', '.join(below)}. {_worst_poses(data)} "
        f"With the estimated axis the map labelled `direct` is the direct one on {right} of {len(notes)} pairs; its mean error "
        f"against the plain truth, no flip forgiven, is {plain:.4f}. At the benchmark's own landmarks, the points of BIM's "
        f"flip-forgiven errors: torchqm {marks[f'{key}, at landmarks']['mean']:.4f}, "
        f"BIM {marks['BIM, published, at landmarks']['mean']:.4f}. "
        "BIM's column is its published error at its own 1,024 samples a pair."
    )


def _worst_poses(data: dict[str, Any], n: int = 2) -> str:
    """Where the paper's way loses most against its own exact axis."""
    losses = []
    for row in data["classes"].values():
        for pose, means in row["figure8_means"].items():
            losses.append((means["paper, estimated axis"] - means["paper, exact axis"], pose, means))
    worst = sorted(losses, reverse=True, key=lambda loss: loss[0])[:n]
    each = [f"{p} {m['paper, estimated axis']:.3f} instead of {m['paper, exact axis']:.3f}" for _, p, m in worst]
    return (
        "Where the paper's way stays behind its own exact axis it is the left-right map of single poses that fails; the "
        f"symmetries that lose most: {', '.join(each)}."
    )


def creatures(data: dict[str, Any]) -> str:
    """Transferred symmetry and the better of the two maps."""
    keys = ("symmetry", "better of the two maps", "first map, plain")
    lines = [
        f"Built-in creatures, source and target with triangulations of their own, `{data['command']}`: mean error (worst pair):",
        "",
        _row(["creature", "method", "pairs", *keys, "labelled"]),
        _row(["---"] * 7),
    ]
    for kind, methods in data["kinds"].items():
        for method, row in methods.items():
            cells = [f"{row[k]['mean']:.4f} ({row[k]['worst']:.4f})" for k in keys]
            lines.append(_row([kind, method, str(row["pairs"]), *cells, f"{row['labelled']}"]))
    return "\n".join(lines)


def pairs(files: list[dict[str, Any]]) -> str:
    """TOSCA without help: symmetries of single shapes, and the published pairs."""
    commands = "` and `".join(data["command"] for data in files)
    classes = {name: row for data in files for name, row in data["classes"].items()}
    lines = [
        f"TOSCA from start to end without help, `{commands}`: the symmetry of each shape from its own spectrum (no plane, no",
        "reference), then the published pairs as `torchqm match` does them; mean error (worst shape or pair), no flip forgiven (of symmetries",
        "over the shapes where one was found; the next column counts the others, too); BIM's",
        "published plain error on the same pairs. Tuned on wolf, centaur, cat and david alone; gorillas have no undeformed pose, so no",
        "truth for symmetries, and dogs are numbered otherwise in the published results, so no pairs. `direct`: pairs whose first map",
        "is labelled direct, and is. Seconds are those of the matching; symmetries count for the shapes.",
        "",
        _row(
            [
                "class",
                "shapes",
                "symmetry",
                "below 0.03",
                "pairs",
                "first map, plain",
                "BIM, plain",
                "direct",
                "seconds a shape, a pair",
                "paper's pipeline, a pair",
            ]
        ),
        _row(["---"] * 10),
    ]
    for name, row in [*classes.items(), ("all", _all_pairs(classes))]:
        symmetry, share, plain, bim, direct = "", "", "", "", ""
        if row["symmetry_error"] is not None:
            symmetry = f"{row['symmetry_error']:.4f} ({row['symmetry_worst']:.4f})"
            share = _below(classes.values() if name == "all" else [row])
        if row["plain"] is not None:
            plain = f"{row['plain']:.4f} ({row['plain_worst']:.4f})"
            bim = f"{row['bim_plain']:.4f}"
            direct = f"{row['direct']} of {row['pairs_with_labels_judged']}"
        seconds = f"{row['seconds_symmetry']:.1f}, " + (f"{row['seconds_match']:.1f}" if row["pairs"] else "-")
        paper = "" if row["seconds_paper"] is None else f"{row['seconds_paper']:.1f}"
        lines.append(
            _row([name, str(row["shapes"]), symmetry, share, str(row["pairs"]), plain, bim, direct, seconds, paper])
        )
    return "\n".join(lines)


def _all_pairs(classes: dict[str, Any]) -> dict[str, Any]:
    """Means over all shapes and pairs, each counting once."""
    shapes = [row for data in classes.values() for row in data["each_shape"].values()]
    rows = [row for data in classes.values() for row in data["each_pair"].values()]
    errors = [row["error"] for row in shapes if row["error"] is not None]
    plain = [row["plain"] for row in rows]
    paper = [row["seconds_paper"] for row in rows if "seconds_paper" in row]
    return {
        "shapes": len(shapes),
        "symmetry_error": sum(errors) / len(errors),
        "symmetry_worst": max(errors),
        "pairs": len(rows),
        "plain": sum(plain) / len(plain),
        "plain_worst": max(plain),
        "bim_plain": sum(row["bim_plain"] for row in rows) / len(rows),
        "direct": sum(bool(row.get("direct")) for row in rows),
        "pairs_with_labels_judged": sum("direct" in row for row in rows),
        "seconds_symmetry": sum(row["seconds"] for row in shapes) / len(shapes),
        "seconds_match": sum(row["seconds"] for row in rows) / len(rows),
        "seconds_paper": sum(paper) / len(paper) if paper else None,
    }


def _below(classes: Iterable[dict[str, Any]]) -> str:
    """How many symmetries have an error below 0.03, of all shapes of classes with a truth; those not found are above."""
    errors = [[row["error"] for row in data["each_shape"].values()] for data in classes]
    errors = [of for of in errors if any(e is not None for e in of)]
    return f"{sum(e is not None and e < 0.03 for of in errors for e in of)} of {sum(map(len, errors))}"


def detect(data: dict[str, Any]) -> str:
    """Symmetry groups of creatures from their own spectrum."""
    lines = [
        f"Symmetry groups of built-in creatures from their own spectrum, `{data['command']}`: random poses, {data['vertices']:,} vertices,",
        "triangulations of their own; mean error of the elements where the group is right (worst shape):",
        "",
        _row(["creature", "group", "shapes", "verdict and group right", "error", "seconds a shape"]),
        _row(["---"] * 6),
    ]
    for name, row in data["creatures"].items():
        error = "none to find" if row["mean_error"] is None else f"{row['mean_error']:.4f} ({row['worst_error']:.4f})"
        lines.append(
            _row(
                [name, data["groups"][name], str(row["shapes"]), str(row["right"]), error, f"{row['mean_seconds']:.1f}"]
            )
        )
    return "\n".join(lines)


def speed(data: dict[str, Any]) -> str:
    """Seconds after the eigenpairs."""
    quotient, paper = data["methods"]["quotient"], data["methods"]["paper"]
    search = quotient["search"]
    return (
        f"Time, `{data['command']}` on {data['machine']['cpus']} cores ({data['machine']['processor']}), "
        f"{data['vertices'][0]:,} and {data['vertices'][1]:,} vertices, everything after the eigenpairs (mirror plane, symmetry "
        f"transfer, both maps), median of {data['repeats']}: {quotient['seconds']:.1f} s, with `--method paper` "
        f"{paper['seconds']:.1f} s; peak memory {data['peak_mib'] / 1024:.1f} GiB. With exhaustive nearest-neighbour searches "
        f"the first takes {quotient['ratio']:.1f} times as long; the fast search finds the same vertex for "
        f"{search['same_vertex']:.1%} of the vertices and is {search['mean_gap']:.5f} sqrt(area) off on average."
    )


def eigenpairs(data: dict[str, Any]) -> str:
    """Seconds, ratios and accuracy of the eigensolvers."""
    names = ["torchqm", "scipy eigsh (pyFM's call)", "eigsh with cholespy"]
    lines = [
        f"Eigenpairs, `{data['command']}`, {data['threads']} threads, {data['machine']['cpus']} cores ({data['machine']['processor']}): median seconds, in brackets how many",
        "times as fast as `eigsh(W, k, M, sigma=-0.01)` in the same run; largest relative residual of torchqm's pairs; peak memory.",
        "",
        _row(["mesh", "vertices", "k", "runs", *names, "residual", "MiB, torchqm", "MiB, eigsh"]),
        _row(["---"] * (7 + len(names))),
    ]
    for case in data["cases"]:
        rows = case["solvers"]
        cells = [f"{rows[n]['seconds']:.2f} ({rows[n]['ratio']:.1f})" for n in names]
        peaks = [f"{rows[n]['peak_mib']:.0f}" for n in names[:2]]
        head = [case["mesh"], f"{case['n_verts']:,}", str(case["k"]), str(case["repeats"])]
        lines.append(_row([*head, *cells, f"{rows['torchqm']['residual_max']:.0e}", *peaks]))
    found = [
        case["solvers"]["lobpcg with cholespy"] for case in data["cases"] if "lobpcg with cholespy" in case["solvers"]
    ]
    if found:
        lines += [
            "",
            f"LOBPCG, preconditioned with the same factor, took {found[0]['seconds']:.0f} s at 28k and 200, to a residual of {found[0]['residual_max']:.0e}.",
        ]
    return "\n".join(lines)


def whole_pair(data: dict[str, Any]) -> str:
    """From mesh files to maps."""
    a, b = data["pair"]
    lines = [
        f"A whole pair, `{data['command']}`, {data['threads']} threads: {a} -> {b}, {data['vertices'][0]:,} and {data['vertices'][1]:,} vertices, from mesh files to the",
        f"dense maps (torchqm: both, pyFM: one); median seconds, mean plain error at {data['points']} points, peak memory.",
        "",
        _row(["method", "runs", "seconds", "times torchqm's", "plain error", "GiB"]),
        _row(["---"] * 6),
    ]
    for name, row in data["methods"].items():
        cells = [
            f"{row['seconds']:.1f}",
            f"{row['times_torchqm']:.1f}",
            f"{row['plain']:.4f}",
            "" if row["peak_mib"] is None else f"{row['peak_mib'] / 1024:.1f}",
        ]
        lines.append(_row([name, str(len(row["all_seconds"])), *cells]))
    return "\n".join(lines)


def growth(data: dict[str, Any]) -> str:
    """Largest sizes and exponents."""
    last = {part: [row for row in rows if "seconds" in row][-1] for part, rows in data["rows"].items()}
    each = [
        f"{words} of {last[part]['n_verts']:,} vertices {last[part]['seconds']:.0f} s and {last[part]['peak_mib'] / 1024:.1f} GiB, growing as n^{data['exponents'][part + '_seconds']:.2f} and n^{data['exponents'][part + '_peak_mib']:.2f}"
        for part, words in (("basis", f"{data['k']} eigenpairs"), ("match", "both maps of a pair"))
    ]
    return (
        f"Growth, `{data['command']}`, one thread, a quadruped subdivided again and again: {'; '.join(each)} (fitted from 4,000 vertices on).\n\n"
        "![Seconds and memory against the number of vertices](docs/speed_growth.png)"
    )


def learning(data: dict[str, Any]) -> str:
    """Learned and wave kernel descriptors in three set-ups and in the classical matcher."""
    lines = [
        f"Learned descriptors, `{data['command'].split(' --out')[0]}`: trained on built-in creatures as `configs/experiment/quick.yaml` says, tested on {data['n_pairs']} pairs of unseen",
        f"bodies and triangulations; mean geodesic error / sqrt(area) at {data['points']} points, over the seeds in the third column (WKS has nothing to train).",
        "The classical rows are `torchqm.match` with true symmetries.",
        "",
        _row(["set-up", "features", "seeds", "direct error", "orbit error", "flipped maps", "flipped points"]),
        _row(["---"] * 7),
    ]
    for row in data["table"]:
        cells = [
            f"{row[key]:.4f}" + (f" +- {row[key + '_std']:.4f}" if row.get(key + "_std") else "")
            for key in ("direct", "orbit")
        ]
        lines.append(
            _row(
                [
                    row["setup"],
                    row["features"],
                    str(row["runs"]),
                    *cells,
                    f"{row['flipped_maps']:.2f}",
                    f"{row['flipped_points']:.3f}",
                ]
            )
        )
    return "\n".join(lines)


def startup(data: dict[str, Any]) -> str:
    """What the package adds to torch's own start."""
    added, help_ = (data["goals"][name]["wall_s"] for name in ("import torchqm, torch", "torchqm --help"))
    return (
        f"Start-up, `{data['command']}`: `import torchqm` takes {added:.2f} s beyond `import torch`, "
        f"`torchqm --help` {help_:.2f} s."
    )


def layers(data: dict[str, Any]) -> str:
    """Time and memory of the layers."""
    solver, blocks, basis, soft = (data[part] for part in ("solver", "blocks", "basis", "soft_map"))
    case = solver["coefficients"]
    pose = basis["in a pose"]
    times = {name: pose[name]["checked"]["total_ms"] for name in ("float32", "float64")}
    return (
        f"Layers, `{data['command']}`, {data['machine']['torch_threads']} threads, forward and backward, medians of {data['repeats']}. "
        f"Functional map, B = {solver['batch']}, K = {solver['k']}, C = {solver['descriptors']}, float32: "
        f"{case['times_as_fast']['kept']:.1f} times as fast as an inverse for each row, in {case['share_of_memory']['kept']:.2f} of its "
        f"memory ({case['median_ms']['kept']:.0f} ms against {case['median_ms']['twin']:.0f} ms from coefficients). Even and odd block of "
        f"100 functions against one map of 200: {blocks['times_as_fast']:.1f} times as fast. Symmetrised basis of "
        f"{pose['float32']['vertices']:,} vertices, K = {basis['k']}: {times['float32']:.0f} ms in float32, {times['float64']:.0f} ms in "
        f"float64; {pose['float32']['bounds']['products_ms']:.0f} and {pose['float64']['bounds']['products_ms']:.0f} ms of it are "
        f"the products with the basis. Soft map of 10,000 x 10,000 vertices, C = 256, 30 neighbours: {soft['worst_extra_gib']:.2f} GiB beside "
        f"the features (dense: {soft['dense']['extra_gib']:.2f} GiB)."
    )


def geodesics(data: dict[str, Any]) -> str:
    """What sharing a factorisation gains, and farthest points by pruned fronts."""
    case = next(c for c in data["cases"] if c["n_verts"] > 50000)
    march, heat = case["solvers"]["fast_marching"], case["solvers"]["heat"]
    most = max(data["cases"][-1]["farthest_points"].items(), key=lambda item: int(item[0]))
    return (
        f"Geodesics, `{data['command']}`, one thread: {data['calls']} calls of three rows on {case['n_verts']:,} vertices take "
        f"{march['calls_shared']:.1f} s by fast marching (each with a set-up of its own: {march['calls_anew']:.1f} s) and "
        f"{heat['calls_shared']:.1f} s by the heat method ({heat['calls_anew']:.1f} s); {int(most[0]):,} farthest points of "
        f"{data['cases'][-1]['n_verts']:,} vertices {most[1]['fronts']:.1f} s (by whole runs {most[1]['whole_runs']:.1f} s)."
    )


def comparison(folder: Path) -> str:
    """Means of `torchqm benchmark` on TOSCA over the pairs that all methods solved, a row a method, and its figures."""
    run = json.loads((folder / "run.json").read_text())["arguments"]
    command = " ".join(["torchqm benchmark", run["root"], *(f"--{name} {run[name]}" for name in ("pairs", "methods"))])
    found: dict[str, dict[str, list[str]]] = {}
    for line in (folder / "table.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 16 and cells[0] in ("plain", "map", "orbit", "symmetry"):
            found.setdefault(cells[1], {})[cells[0]] = cells
    rows = [
        _row(["method", "pairs", "plain", "map", "<= 0.05", "orbit", "symmetry", "flipped maps", "seconds"]),
        _row(["---"] * 9),
    ]
    for method, protocols in found.items():
        one = protocols.get("map", protocols.get("symmetry"))
        means = {
            name: protocols[name][5].split()[0] if name in protocols else ""
            for name in ("plain", "map", "orbit", "symmetry")
        }
        share, flipped = (one[9], one[13]) if "map" in protocols else ("", "")
        rows.append(
            _row(
                [
                    method,
                    one[2],
                    means["plain"],
                    means["map"],
                    share,
                    means["orbit"],
                    means["symmetry"],
                    flipped,
                    one[14],
                ]
            )
        )
    common = next(cells["map"][5].split()[1].strip("()") for cells in found.values() if "map" in cells)
    return (
        f"Comparison on TOSCA's published pairs, all classes, `{command}`: mean geodesic error / sqrt(area) over the {common} pairs that "
        "all methods solved (axes are not known of gorillas), against the plain truth, the better of the two truths for the whole "
        "map (Figure 10), point by point up to symmetry (Figure 6), and of each shape's symmetry (Figure 8); share of points below 0.05 "
        "by the second, and median seconds, those of symmetries included, eigenfunctions not; one pair at a time with one thread, on a machine that had other work, too. All numbers: "
        "`benchmarks/results/comparison/`.\n\n" + "\n".join(rows) + "\n\n"
        "![Cumulative errors, the better of direct and mirrored truth for the whole map](docs/comparison_map.png)\n"
        "![Cumulative errors, point by point up to symmetry](docs/comparison_orbit.png)\n"
        "![Cumulative errors of self-symmetries](docs/comparison_symmetry.png)"
    )


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    parts = []
    found = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("tosca*.json"))]
    if found:
        parts.append(tosca(joined(found)))
    found = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("pairs*.json"))]
    if found:
        parts.append(pairs(found))
    for name, make in (("creatures", creatures), ("detect", detect), ("speed_pair", speed)):
        found = [json.loads(path.read_text()) for path in sorted(RESULTS.glob(f"{name}*.json"))]
        if len(found) > 1:
            found[0]["command"] = "` and `".join(data["command"] for data in found)
            found[0]["creatures"] = {k: v for data in found for k, v in data["creatures"].items()}
        if found:
            parts.append(make(found[0]))
    if (RESULTS / "evaluate_speed.json").exists():
        speed_of = json.loads((RESULTS / "evaluate_speed.json").read_text())
        parts.append(
            f"Evaluation, `{speed_of['command']}`: {speed_of['shapes']} shapes ({speed_of['vertices']:,} vertices in all) read with their "
            f"eigenfunctions from the cache and a map to each measured, {speed_of['seconds']:.0f} s with {speed_of['jobs']} processes."
        )
    single = {
        "layers": layers,
        "speed_eigenpairs": eigenpairs,
        "speed_match": whole_pair,
        "speed_growth": growth,
        "speed_geodesics": geodesics,
        "startup": startup,
        "learning": learning,
    }
    for name, make in single.items():
        if (RESULTS / f"{name}.json").exists():
            parts.append(make(json.loads((RESULTS / f"{name}.json").read_text())))
    if (RESULTS / "comparison").exists():
        parts.insert(0, comparison(RESULTS / "comparison"))
    readme = ROOT / "README.md"
    text = readme.read_text()
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    new = f"{head}{BEGIN}\n{(chr(10) * 2).join(parts) or 'No results yet.'}\n{END}{tail}"
    if args.check:
        print("README.md is up to date" if new == text else "README.md differs from benchmarks/results/")
        return int(new != text)
    write_whole(Path(readme), lambda file: file.write(new.encode()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
