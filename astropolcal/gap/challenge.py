# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sealed challenges, which ask whether the diagnosis is right where the truth is known.

A challenge is a simulated calibration of an instrument with a random effect in
it, or none, or one that no library holds. The diagnosis sees the data and the
nominal chains; the key stays sealed until it has answered. Many of them give
recall, false alarms, errors of the sizes, and the gap that is left, against the
signal-to-noise ratio of the effect.
"""

import json
import os
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable
from tqdm import tqdm

from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.gap._bench import _UNKNOWN, Key, Setup, _Bench, _plant
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.effects import get_effect
from astropolcal.gap.model import _canonical
from astropolcal.gap.shrinkage import frame_groups, held_out

__all__ = [
    "KINDS",
    "ChallengeResult",
    "Key",
    "Setup",
    "make_challenge",
    "run_challenge",
]

#: Kinds of challenges, and how often each is drawn where nothing else is asked for.
KINDS = {
    "single": 0.45,
    "none": 0.15,
    "pair": 0.12,
    "absorbed": 0.07,
    "unlisted": 0.08,
    "withheld": 0.08,
}
# a size counts as measured where its error is below this share of its prior
_MEASURED = 0.3


def make_challenge(seed, *, kind="single", effect=None, snr=30.0, setup=None):
    """
    Make a sealed challenge.

    Parameters
    ----------
    seed : int or `~numpy.random.SeedSequence`
        Seed of everything that is random.
    kind : str
        ``"single"``: an effect of the library. ``"none"``: no effect. ``"pair"``:
        two effects. ``"absorbed"``: an effect that the nominal parameters take
        up. ``"unlisted"``: an effect that is in no library. ``"withheld"``: an
        effect that is to be taken out of the library that is asked.
    effect : str, optional
        The effect; by default one is drawn.
    snr : float
        Signal-to-noise ratio of each effect, after the nominal model is fitted
        again. An effect that cannot be so large is as large as it can.
    setup : Setup, optional
        What is simulated.

    Returns
    -------
    observations : list of Observations
        The datasets.
    chains : list
        Their nominal chains, at starting values that are not the truth.
    key : Key

    Raises
    ------
    GapError
        If the kind or the effect is unknown, or no effect fits the kind.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, make_challenge
    >>> small = Setup(n_wavelengths=5, n_derotator=3)
    >>> data, chains, key = make_challenge(1, effect="beam_gain", snr=20, setup=small)
    >>> [observations.n_frames for observations in data], round(key.snr[0])
    ([24, 24], 20)
    """
    if kind not in KINDS:
        raise GapError(f"kind = {kind!r}; allowed are {', '.join(KINDS)}")
    if not (np.isfinite(snr) and snr > 0):
        raise GapError(f"snr = {snr}; it must be finite and positive")
    bench = _Bench(Setup() if setup is None else setup, np.random.default_rng(seed))
    planted = [] if kind == "none" else _plant(bench, kind, effect, snr)
    key = Key(
        kind,
        [one.name for one in planted],
        [one.snr for one in planted],
        [one.shares for one in planted],
        [one.values for one in planted],
    )
    fluxes, key.chains = bench.expose(planted)
    return bench.record(fluxes), bench.setup.chains(), key


# ---- a challenge is answered and scored ------------------------------------------------------


def _answer(observations, chains, key):
    """Diagnose blind, then open the key; return a record."""
    record = {"kind": key.kind, "effects": key.effects, "snr": key.snr}
    record["alternatives"] = [
        {name: share for name, share in shares.items() if share >= _UNKNOWN}
        for shares in key.alternatives
    ]
    try:
        diagnosis = diagnose(chains, observations, effects=key.library)
    except AstropolcalError as error:
        return record | {"verdict": "error", "right": False, "error": str(error), "causes": []}
    groups = [[cause.name, *cause.aliases] for cause in diagnosis.causes]
    record |= {
        "verdict": diagnosis.verdict,
        "causes": groups,
        "explained": [round(cause.explained, 4) for cause in diagnosis.causes],
        "remainder_p_value": diagnosis.remainder_p_value,
        "right": _is_right(key, diagnosis.verdict, groups),
        "seconds": round(diagnosis.seconds, 2),
    }
    if key.kind in ("single", "pair"):
        record |= _sizes_and_shrinkage(observations, key, diagnosis)
    return record


def _is_right(key, verdict, groups):
    if key.kind in ("none", "absorbed"):
        return verdict == "none"
    if key.kind in ("unlisted", "withheld"):
        return verdict == "unexplained"
    if verdict != "effect":
        return False
    if key.kind == "pair":
        named = {name for group in groups for name in group}
        return all(names & named for names in key.accepted)
    return bool(key.accepted[0] & set(groups[0])) if groups else False


def _sizes_and_shrinkage(observations, key, diagnosis):
    """Return the pulls of the sizes, and how far the gap shrank, against an oracle."""
    oracle = diagnosis.nominal
    for name in key.effects:
        oracle = oracle.with_effect(get_effect(name))
    last = held_out(oracle, frame_groups(observations))
    before, after = diagnosis.held_out[0], diagnosis.held_out[-1]
    found = [name for name in key.effects if name in diagnosis.improved.added]
    return {
        "gap_percent": [one.percent for one in (before, after, last)],
        "gap_chi2": [one.chi2 for one in (before, after, last)],
        "pulls": _pulls(diagnosis.improved, key, found),
    }


def _pulls(model, key, names):
    """Return fitted less true coefficients by their errors, where the data determine them."""
    if not names:
        return []
    errors, found = model.problem.errors(model.fit.coefficients), []
    for name in names:
        values = key.values[key.effects.index(name)]
        for parameter in model.added[name]:
            where = model.problem.slices[parameter.name]
            true = np.atleast_1d(values[parameter.name])
            if parameter.basis is not None:
                true = np.linalg.lstsq(parameter.basis, true, rcond=None)[0]
            measured = errors[where] < _MEASURED * _canonical(parameter.limit) / 2
            pull = (model.fit.coefficients[where] - true) / errors[where]
            found += [round(float(p), 4) for p in pull[measured]]
    return found


def _run_one(index, settings):
    """Make, answer and score the challenge of that number."""
    seed = np.random.SeedSequence(settings["seed"], spawn_key=(index,))
    choice, making = (np.random.default_rng(s) for s in seed.spawn(2))
    kinds = settings["kinds"]
    weights = np.array([KINDS[kind] for kind in kinds])
    kind = str(choice.choice(kinds, p=weights / weights.sum()))
    low, high = settings["snr"]
    snr = float(np.exp(choice.uniform(np.log(low), np.log(high))))
    setup = Setup(**settings["setup"])
    try:
        sealed = make_challenge(making, kind=kind, snr=snr, setup=setup)
    except AstropolcalError as error:
        return {"index": index, "kind": kind, "verdict": "not made", "error": str(error)}
    return {"index": index, "target": snr, **_answer(*sealed)}


def run_challenge(
    n,
    seed=0,
    *,
    snr=(8.0, 300.0),
    kinds=tuple(KINDS),
    setup=None,
    client=None,
    checkpoint=None,
    progress=False,
):
    """
    Make challenges, diagnose each blind, and score the answers.

    Parameters
    ----------
    n : int
        How many.
    seed : int
        Challenge number i of a seed is always the same.
    snr : (float, float)
        Range of the signal-to-noise ratio, drawn evenly in its logarithm.
    kinds : sequence of str
        Of ``KINDS``, drawn with the frequencies given there.
    setup : Setup, optional
        What is simulated.
    client : optional
        A ``dask.distributed.Client``, or an executor of ``concurrent.futures``;
        by default they run here, one after the other.
    checkpoint : path-like, optional
        File to which each record is appended as a line of JSON. A run with the
        same settings goes on from it.
    progress : bool
        Whether to show a bar on a terminal.

    Returns
    -------
    ChallengeResult

    Raises
    ------
    GapError
        If a number or kind is not allowed, or the checkpoint is of other settings.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup, run_challenge
    >>> small = Setup(n_wavelengths=5, n_derotator=3)
    >>> run_challenge(1, seed=2, kinds=["single"], snr=(60, 60), setup=small).rate("single")[0]
    1.0
    """
    settings = _settings(n, seed, snr, kinds, Setup() if setup is None else setup)
    records = _journal(checkpoint, settings)
    todo = [i for i in range(n) if i not in records]
    # disable=None shows the bar on a terminal only
    hidden = None if progress else True
    with tqdm(total=n, initial=n - len(todo), desc="challenges", disable=hidden) as bar:
        for record in _outcomes(todo, settings, client):
            records[record["index"]] = record
            _append(checkpoint, record)
            bar.update()
    return ChallengeResult([records[i] for i in range(n)], settings)


def _settings(n, seed, snr, kinds, setup):
    for name, value in (("n", n), ("seed", seed)):
        if not isinstance(value, (int, np.integer)) or value < (name == "n"):
            raise GapError(f"{name} = {value!r}; allowed are whole numbers from {int(name == 'n')}")
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not len(kinds):
        raise GapError(f"kinds = {list(kinds)}; allowed are {', '.join(KINDS)}")
    low, high = (float(x) for x in snr)
    if not (0 < low <= high < np.inf):
        raise GapError(f"snr = {snr}; allowed are two positive numbers, the lower first")
    return {"seed": int(seed), "snr": [low, high], "kinds": list(kinds), "setup": asdict(setup)}


def _outcomes(todo, settings, client):
    """Yield records as they are ready."""
    if client is None:
        for index in todo:
            yield _run_one(index, settings)
        return
    futures = [client.submit(_run_one, index, settings) for index in todo]
    if type(client).__module__.startswith("distributed"):
        from distributed import as_completed
    else:
        from concurrent.futures import as_completed
    for future in as_completed(futures):
        yield future.result()


def _journal(path, settings):
    """Return the records of a checkpoint; the first line of the file holds the settings."""
    if path is None:
        return {}
    path = Path(path)
    if not path.exists() or not path.stat().st_size:
        _append(path, {"settings": settings})
        return {}
    text = path.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    try:
        first, *others = [json.loads(line) for line in whole.splitlines()]
        known, records = first["settings"], {_index(record): record for record in others}
        # whatever is asked of the records must have an answer
        result = ChallengeResult(list(records.values()), known)
        repr(result), result.summary(), result.table
    except Exception:  # a damaged line may hold anything
        raise GapError(f"{path}: is no checkpoint of challenges") from None
    wrong = [key for key in settings if known.get(key) != settings[key]]
    if wrong:
        raise GapError(f"{path}: is of other settings ({', '.join(wrong)}); remove it")
    # a run that was killed may have left half a line
    os.truncate(path, len(whole))
    return records


def _index(record):
    """Return the number of a record that has what a record has, or raise."""
    numbers = [record.get(key, []) for key in ("snr", "gap_percent", "pulls")]
    plain = all(isinstance(x, int | float) for part in numbers for x in part)
    texts = all(isinstance(record[key], str) for key in ("kind", "verdict"))
    if type(record["index"]) is not int or not (plain and texts):
        raise TypeError("no record of a challenge")
    if "right" in record and not isinstance(record["right"], bool):
        raise TypeError("right or wrong")
    return record["index"]


def _append(path, content):
    if path is None:
        return
    try:
        with open(path, "ab") as stream:
            stream.write((json.dumps(content) + "\n").encode())
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as problem:
        raise GapError(f"{path}: cannot be written: {problem.strerror}") from problem


# ---- what came out ---------------------------------------------------------------------------


class ChallengeResult:
    """
    Outcome of many challenges.

    Parameters
    ----------
    records : list of dict
        One a challenge.
    settings : dict
        Seed, range of the signal-to-noise ratio, kinds and set-up.

    Examples
    --------
    >>> from astropolcal.gap.challenge import ChallengeResult
    >>> record = {"kind": "none", "verdict": "none", "right": True, "snr": [], "index": 0}
    >>> ChallengeResult([record], {}).rate("none")[0]
    1.0
    """

    def __init__(self, records, settings):
        self.records, self.settings = list(records), dict(settings)

    def of(self, *kinds, least=0.0, below=np.inf):
        """Return the records of some kinds whose weakest effect is in a range of SNR."""
        answered = [r for r in self.records if r["kind"] in kinds and "right" in r]
        return [r for r in answered if not r["snr"] or least <= min(r["snr"]) < below]

    def rate(self, *kinds, least=0.0, below=np.inf):
        """
        Return the share of right answers.

        Parameters
        ----------
        *kinds : str
            Of ``KINDS``.
        least, below : float
            Range of the signal-to-noise ratio of the weakest effect.

        Returns
        -------
        rate, low, high : float
            With the interval of Wilson (1927) at 68 %; NaN where there are none.
        count : int
        """
        right = [record["right"] for record in self.of(*kinds, least=least, below=below)]
        return (*_wilson(sum(right), len(right)), len(right))

    def pulls(self, least=8.0):
        """Return fitted less true coefficients over their errors, shape (n,)."""
        parts = [record.get("pulls", []) for record in self.of("single", "pair", least=least)]
        return np.array([pull for part in parts for pull in part])

    def shrinkage_ratio(self, least=8.0):
        """Return how far the held-out mean squares shrink, over how far with the true effects."""
        scored = self.of("single", "pair", least=least)
        gaps = [r["gap_percent"] for r in scored if "gap_percent" in r]
        if not gaps:
            return np.nan
        before, after, oracle = np.square(np.array(gaps)).T
        return float(np.sum(1 - after / before) / np.sum(1 - oracle / before))

    @property
    def failures(self):
        """Records whose answer was wrong."""
        return [record for record in self.records if record.get("right") is False]

    @property
    def table(self):
        """One row a challenge."""
        rows = [record for record in self.records if "right" in record]
        table = QTable()
        table["index"] = [r["index"] for r in rows]
        table["kind"] = [r["kind"] for r in rows]
        table["effect"] = [" + ".join(r["effects"]) for r in rows]
        table["snr"] = [min(r["snr"], default=0.0) for r in rows]
        table["verdict"] = [r["verdict"] for r in rows]
        table["answer"] = [" + ".join("|".join(g) for g in r["causes"]) for r in rows]
        table["right"] = [r["right"] for r in rows]
        gaps = [r.get("gap_percent", [np.nan] * 3) for r in rows]
        for i, name in enumerate(("gap_before", "gap_after", "gap_oracle")):
            table[name] = np.array([gap[i] for gap in gaps]) * u.percent
        return table

    def summary(self):
        """Return rates (value, low, high, n) by name, and other numbers."""
        pulls = self.pulls()
        inside = int(np.sum(np.abs(pulls) < 1))
        rates = {
            "recall": self.rate("single", least=8),
            "recall of pairs": self.rate("pair", least=30),
            "unexplained of unknown": self.rate("unlisted", "withheld", least=20),
            "quiet on clean": self.rate("none"),
            "quiet on absorbed": self.rate("absorbed"),
            "coverage of sizes": (*_wilson(inside, len(pulls)), len(pulls)),
        }
        ratio = self.shrinkage_ratio()
        return {
            "rates": {
                name: dict(zip(("value", "low", "high", "n"), rate, strict=True))
                for name, rate in rates.items()
                if rate[-1]
            },
            "shrinkage over oracle": ratio if np.isfinite(ratio) else None,
        }

    def to_dict(self):
        """Return settings, summary and records as a dictionary that JSON takes."""
        return {"settings": self.settings, "summary": self.summary(), "challenges": self.records}

    def words(self):
        """Return the summary as lines of text."""
        summary = self.summary()
        lines = [f"{len(self.records)} challenges, {len(self.failures)} wrong answers"]
        for name, rate in summary["rates"].items():
            value, low, high = (100 * rate[key] for key in ("value", "low", "high"))
            lines.append(f"{name:<24}{value:6.1f} % ({low:.1f} to {high:.1f}; {rate['n']})")
        if summary["shrinkage over oracle"] is not None:
            lines.append(
                f"{'shrinkage over oracle':<24}{100 * summary['shrinkage over oracle']:6.1f} %"
            )
        return "\n".join(lines)

    def plot(self, figure=None, bins=6):
        """
        Draw the share of right answers against the signal-to-noise ratio.

        Parameters
        ----------
        figure : `~matplotlib.figure.Figure`, optional
            An empty figure to draw into.
        bins : int
            Number of bins, evenly in the logarithm.

        Returns
        -------
        `~matplotlib.figure.Figure`
            Points with the interval of Wilson (1927) at 68 %.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.5, 5), layout="constrained") if figure is None else figure
        axes = figure.subplots()
        edges = np.geomspace(*self.settings["snr"], bins + 1)
        # a size is reached within two percent
        edges[[0, -1]] *= 0.95, 1.05
        for i, curve in enumerate(_CURVES):
            self._draw(axes, edges, 1 + 0.04 * (i - 1), *curve)
        quiet = self.rate("none", "absorbed")
        if quiet[3]:
            label = f"nothing to be found, and nothing said ({quiet[3]})"
            axes.axhline(100 * quiet[0], color="0.45", linestyle="--", label=label)
            axes.axhspan(100 * quiet[1], 100 * quiet[2], color="0.45", alpha=0.15, linewidth=0)
        axes.set(xscale="log", xlim=edges[[0, -1]], ylim=(-4, 104), ylabel="right answers (%)")
        axes.set_xlabel("signal-to-noise ratio of the weakest effect")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(color="0.88", linewidth=0.7)
        figure.legend(loc="outside lower center", ncols=1, frameon=False)
        figure.suptitle(f"{len(self.records)} sealed challenges, 68 % binomial intervals")
        return figure

    def _draw(self, axes, edges, shift, label, kinds, color, marker):
        pairs = pairwise(edges)
        rates = np.array([self.rate(*kinds, least=low, below=high) for low, high in pairs])
        seen = rates[:, 3] > 0
        if not seen.any():
            return
        middle = shift * np.sqrt(edges[:-1] * edges[1:])[seen]
        value, low, high = 100 * rates[seen, :3].T
        bars = [np.maximum(value - low, 0), np.maximum(high - value, 0)]
        label = f"{label} ({int(rates[:, 3].sum())})"
        axes.errorbar(middle, value, bars, color=color, marker=marker, capsize=2.5, label=label)


# Okabe & Ito (2008), distinct for all kinds of colour vision
_CURVES = (
    ("one effect, named first or in the first group", ("single",), "#0072B2", "o"),
    ("two effects, both named", ("pair",), "#D55E00", "s"),
    ("effect that no library holds, called unexplained", ("unlisted", "withheld"), "#009E73", "^"),
)


def _wilson(right, n, z=1.0):
    """Return a share and its interval; Wilson (1927, doi:10.1080/01621459.1927.10502953)."""
    if not n:
        return np.nan, np.nan, np.nan
    p = right / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return p, max(middle - half, 0.0), min(middle + half, 1.0)
