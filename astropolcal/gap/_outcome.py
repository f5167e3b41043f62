# Licensed under a 3-clause BSD style license - see LICENSE
"""Outcome of challenges: rates of right and wrong answers, and how reliable probabilities are."""

from itertools import pairwise

import numpy as np
from astropy.table import QTable

from astropolcal.words import counted

#: What an answer may be; what is wrong is confidently wrong.
RESULTS = ("right", "silent", "wrong")
# Okabe & Ito (2008), distinct for all kinds of colour vision, and in grey
_COLORS = {"right": "#0072B2", "silent": "#D9D9D9", "wrong": "#D55E00"}
_WORDS = {"right": "right", "silent": "silent", "wrong": "confidently wrong"}
_SNR_EDGES = np.array([0, 3, 10, 20, 40, 80, np.inf])
_EDGES = np.array([0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1])


class ChallengeResult:
    """
    Outcome of many challenges.

    Parameters
    ----------
    records : list of dict
        One a challenge: ``index``, ``kind``, ``snr``, ``faults``, ``verdict``, ``causes``,
        ``result``, and ``claims``: the probability of each cause and whether it is right.
    settings : dict
        Seed, range of the signal-to-noise ratio, kinds and set-up.

    Examples
    --------
    >>> from astropolcal.gap.challenge import ChallengeResult
    >>> record = {"index": 0, "kind": "none", "snr": 0.0, "faults": [], "verdict": "none"}
    >>> result = ChallengeResult([record | {"causes": [], "result": "right", "claims": []}], {})
    >>> result.rate("right")[0]
    1.0
    """

    def __init__(self, records, settings):
        self.records, self.settings = list(records), dict(settings)

    def of(self, *kinds, least=-np.inf, below=np.inf):
        """Return the records of some kinds (by default all) in a range of SNR."""
        known = [r for r in self.records if not kinds or r["kind"] in kinds]
        return [r for r in known if least <= r["snr"] < below]

    def rate(self, result, *kinds, **limits):
        """
        Return the share of answers that are right, silent or wrong.

        Parameters
        ----------
        result : str
            ``"right"``, ``"silent"`` or ``"wrong"``.
        *kinds : str
            Of ``KINDS``; by default all.
        **limits : float
            ``least`` and ``below``, a range of the signal-to-noise ratio.

        Returns
        -------
        rate, low, high : float
            With the interval of Wilson (1927) at 68 %; NaN where there are none.
        count : int
        """
        found = [record["result"] for record in self.of(*kinds, **limits)]
        return (*wilson(found.count(result), len(found)), len(found))

    @property
    def rates(self):
        """Table of the rates: all, by kind, and by SNR of what has a fault to be seen."""
        kinds = sorted({record["kind"] for record in self.records})
        rows = [("all", (), {}), *((kind, (kind,), {}) for kind in kinds)]
        for low, high in pairwise(_SNR_EDGES):
            name = f"SNR {low:g} to {high:g}" if np.isfinite(high) else f"SNR over {low:g}"
            rows.append((name, (), {"least": low or 1e-9, "below": high}))
        rows = [row for row in rows if self.of(*row[1], **row[2])]
        table = QTable({"challenges": [row[0] for row in rows]})
        rates = {r: np.array([self.rate(r, *k, **s) for _, k, s in rows]) for r in RESULTS}
        table["n"] = rates["right"].reshape(-1, 4)[:, 3].astype(int)
        for name, values in rates.items():
            for key, column in zip(("", "_low", "_high"), values.reshape(-1, 4).T, strict=False):
                table[name + key] = column
        return table

    @property
    def reliability(self):
        """Table of all causes that were given, by probability, and how many of them are right."""
        claims = np.array([c for record in self.records for c in record["claims"]], dtype=float)
        claims = claims.reshape(-1, 2)
        # the last bin holds certainty too
        which = np.searchsorted(_EDGES, claims[:, 0], side="right").clip(1, len(_EDGES) - 1)
        bins = [claims[which == i] for i in range(1, len(_EDGES))]
        rows = [
            (low, high, len(b), b[:, 0].mean(), *wilson(int(b[:, 1].sum()), len(b)))
            for (low, high), b in zip(pairwise(_EDGES), bins, strict=True)
            if len(b)
        ]
        names = ("from", "to", "n", "probability", "right", "right_low", "right_high")
        return QTable(rows=rows or None, names=names, dtype=[float, float, int, *[float] * 4])

    @property
    def failures(self):
        """Records whose answer was not right."""
        return [record for record in self.records if record["result"] != "right"]

    def to_dict(self):
        """Return settings, tables and records as a dictionary that JSON takes."""
        return {
            "settings": self.settings,
            "rates": _rows(self.rates),
            "reliability": _rows(self.reliability),
            "challenges": self.records,
        }

    def words(self):
        """Return the tables as lines of text."""
        rates, claims = self.rates, self.reliability
        lines = [f"{counted(len(self.records), 'challenge')}; rates with intervals at 68 %, in %"]
        lines.append(f"{'':14}{'n':>5}" + "".join(f"{_WORDS[name]:>20}" for name in RESULTS))
        for row in rates:
            cells = [
                _percent(*(row[name + key] for key in ("", "_low", "_high"))) for name in RESULTS
            ]
            lines.append(f"{row['challenges']:14}{row['n']:5}" + "".join(f"{c:>20}" for c in cells))
        if len(claims):
            lines += [
                "",
                "causes by the probability that was given, and how many of them are right",
            ]
        for row in claims:
            right = _percent(row["right"], row["right_low"], row["right_high"])
            lines.append(f"{100 * row['probability']:13.1f} {row['n']:5}{right:>20}")
        return "\n".join(lines)

    def plot(self, figure=None):
        """
        Draw the rates by kind and by signal-to-noise ratio.

        Parameters
        ----------
        figure : `~matplotlib.figure.Figure`, optional
            An empty figure to draw into.

        Returns
        -------
        `~matplotlib.figure.Figure`
        """
        table = self.rates
        by_snr = np.array([name.startswith("SNR") for name in table["challenges"]], dtype=bool)
        heights = [max(np.sum(~by_snr), 1), max(np.sum(by_snr), 1)]
        figure = _figure(figure, (7.5, 1.6 + 0.3 * sum(heights)))
        axes = figure.subplots(2, 1, height_ratios=heights, sharex=True)
        for ax, rows in zip(axes, (table[~by_snr], table[by_snr]), strict=True):
            left = np.zeros(len(rows))
            for name in RESULTS:
                width = 100 * np.asarray(rows[name])
                ax.barh(
                    range(len(rows)), width, 0.75, left, color=_COLORS[name], label=_WORDS[name]
                )
                dark = "black" if name == "silent" else "white"
                for y, (x, w) in enumerate(zip(left, width, strict=True)):
                    if w > 6:
                        ax.text(x + w / 2, y, f"{w:.0f}", ha="center", va="center", color=dark)
                left += width
            labels = [f"{row['challenges']} ({row['n']})" for row in rows]
            ax.set_yticks(range(len(rows)), labels)
            ax.invert_yaxis()
            ax.spines[["top", "right"]].set_visible(False)
        axes[1].set(xlim=(0, 100), xlabel="answers (%); in brackets: number of challenges")
        if len(table):
            handles = axes[0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside upper center", ncols=3, frameon=False)
        return figure

    def plot_reliability(self, figure=None):
        """
        Draw how many of the causes are right against the probability that was given.

        Parameters
        ----------
        figure : `~matplotlib.figure.Figure`, optional
            An empty figure to draw into.

        Returns
        -------
        `~matplotlib.figure.Figure`
            Points with the interval of Wilson (1927) at 68 %, numbers of causes below.
        """
        figure, table = _figure(figure, (7.5, 5.5)), self.reliability
        top, below = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
        top.plot([0, 100], [0, 100], color="0.5", linestyle="--", label="as it should be")
        x, y, low, high = (
            100 * np.asarray(table[name])
            for name in ("probability", "right", "right_low", "right_high")
        )
        bars = np.maximum([y - low, high - y], 0)
        top.errorbar(x, y, bars, fmt="o", color=_COLORS["right"], capsize=3, label="causes given")
        top.set(ylim=(-3, 103), ylabel="of them right (%)")
        top.legend(loc="upper left", frameon=False)
        left, right = 100 * np.asarray(table["from"]), 100 * np.asarray(table["to"])
        width = right - left
        below.bar(left, table["n"], width, align="edge", color="0.8", edgecolor="0.4")
        for a, w, n in zip(left, width, table["n"], strict=True):
            below.annotate(str(n), (a + w / 2, n), (0, 2), textcoords="offset points", ha="center")
        below.set(xlim=(-3, 103), xlabel="probability that was given (%)", ylabel="causes")
        below.margins(y=0.25)
        for ax in (top, below):
            ax.grid(color="0.9", linewidth=0.7)
            ax.set_axisbelow(True)
        return figure


def _figure(figure, size):
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained") if figure is None else figure


def _rows(table):
    return [{name: _plain(row[name]) for name in table.colnames} for row in table]


def _plain(value):
    return value.item() if isinstance(value, np.generic) else value


def _percent(value, low, high):
    return f"{100 * value:.0f} ({100 * low:.0f} to {100 * high:.0f})"


def wilson(right, n, z=1.0):
    """Return a share and its interval; Wilson (1927, doi:10.1080/01621459.1927.10502953)."""
    if not n:
        return np.nan, np.nan, np.nan
    # the ends e solve |p - e| = z sqrt(e (1 - e) / n), and stay within 0 to 1
    p = right / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return p, max(middle - half, 0.0), min(middle + half, 1.0)


def check_record(record):
    """Raise unless a record of a file has what a record has."""
    texts = ("kind", "verdict", "result")
    good = type(record["index"]) is int and record["result"] in RESULTS
    good &= all(isinstance(record[key], str) for key in texts)
    good &= isinstance(record["snr"], int | float) and np.isfinite(record["snr"])
    for probability, right in record["claims"]:
        good &= isinstance(probability, int | float) and 0 <= probability <= 1
        good &= isinstance(right, bool)
    for key in ("faults", "causes"):
        good &= isinstance(record[key], list) and all(isinstance(x, str) for x in record[key])
    if not good:
        raise TypeError("no record of a challenge")
