# Licensed under a 3-clause BSD style license - see LICENSE
"""Outcome of sealed challenges: rates of right answers, pulls, shrinkage, a figure."""

from collections import Counter
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.words import counted


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
        # a challenge that could not be made has no answer
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
        return (*wilson(sum(right), len(right)), len(right))

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
        # percent to mean squares, which shrink by shares that add up
        before, after, oracle = np.square(np.array(gaps)).T
        return float(np.sum(1 - after / before) / np.sum(1 - oracle / before))

    @property
    def failures(self):
        """Records whose answer was wrong."""
        return [record for record in self.records if record.get("right") is False]

    @property
    def answered(self):
        """Records of the challenges that could be made."""
        return [record for record in self.records if "right" in record]

    @property
    def shortfall(self):
        """How many challenges could be made, and why not the others; empty if all could."""
        reasons = Counter(r.get("error", "not made") for r in self.records if "right" not in r)
        if not reasons:
            return ""
        made, n = len(self.answered), len(self.records)
        why = "; ".join(f"{reason} ({count})" for reason, count in reasons.items())
        others = "; not the others" if made else ""
        return f"{made} of {n} challenges could be made{others}: {why}"

    @property
    def table(self):
        """One row a challenge that could be made."""
        rows = self.answered
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
            # where the range of challenges begins by default
            "recall": self.rate("single", least=8),
            "recall of pairs": self.rate("pair", least=30),
            "unexplained of unknown": self.rate("unlisted", "withheld", least=20),
            "quiet on clean": self.rate("none"),
            "quiet on absorbed": self.rate("absorbed"),
            "coverage of sizes": (*wilson(inside, len(pulls)), len(pulls)),
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
        made, wrong = len(self.answered), counted(len(self.failures), "wrong answer")
        lines = [f"{counted(made, 'challenge')}, {wrong}"] if made else []
        if self.shortfall:
            # what was never asked was not answered rightly either
            lines.insert(0, self.shortfall)
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
            Points with the interval of Wilson (1927) at 68 %. Where no challenge has an
            effect to be found, they are by kind.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.5, 5), layout="constrained") if figure is None else figure
        axes = figure.subplots()
        figure.suptitle(f"{len(self.answered)} sealed challenges, 68 % binomial intervals")
        axes.set(ylim=(-4, 104), ylabel="right answers (%)")
        axes.grid(color="0.88", linewidth=0.7)
        if not any(record["snr"] for record in self.answered):
            self._draw_quiet(axes)
            return figure
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
        axes.set(xscale="log", xlim=edges[[0, -1]])
        axes.set_xlabel("signal-to-noise ratio of the weakest effect")
        axes.xaxis.set_major_formatter("{x:g}")
        figure.legend(loc="outside lower center", ncols=1, frameon=False)
        return figure

    def _draw_quiet(self, axes):
        """Draw the kinds without an effect to be found: they have no signal-to-noise ratio."""
        kinds = [kind for kind in ("none", "absorbed") if self.of(kind)]
        for i, kind in enumerate(kinds):
            value, low, high, n = self.rate(kind)
            bar = 100 * np.array([[max(value - low, 0)], [max(high - value, 0)]])
            axes.errorbar(i, 100 * value, bar, color="0.3", marker="o", capsize=2.5)
            axes.annotate(
                counted(n, "challenge"), (i, 100 * value), (8, -12), textcoords="offset points"
            )
        axes.set_xticks(range(len(kinds)), labels=kinds)
        axes.set(xlim=(-1, max(len(kinds), 1)), xlabel="kind of challenge, no effect to be found")

    def _draw(self, axes, edges, shift, label, kinds, color, marker):
        pairs = pairwise(edges)
        rates = np.array([self.rate(*kinds, least=low, below=high) for low, high in pairs])
        seen = rates[:, 3] > 0
        if not seen.any():
            return
        # side by side, lest the bars of the curves cover each other
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


def wilson(right, n, z=1.0):
    """Return a share and its interval; Wilson (1927, doi:10.1080/01621459.1927.10502953)."""
    if not n:
        return np.nan, np.nan, np.nan
    # the ends e solve |p - e| = z sqrt(e (1 - e) / n), and stay within 0 to 1
    p = right / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return p, max(middle - half, 0.0), min(middle + half, 1.0)
