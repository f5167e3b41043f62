# Licensed under a 3-clause BSD style license - see LICENSE
"""The data of a calibration and its model against angles, and maps of what is left between them."""

from collections import namedtuple

import astropy.units as u
import numpy as np

from astropolcal.chain import stages, standing
from astropolcal.exceptions import ObservationError, ParameterError, WavelengthRangeError
from astropolcal.observations.grid import clusters, is_star
from astropolcal.optics import COORDINATES
from astropolcal.plotting import _style as st
from astropolcal.propagation import Propagator

__all__ = ["plot_double_differences"]

# angles (deg) that differ by less are the same setting of a stage
SAME_ANGLE = 0.5


# what tells where the sky stands, the first is drawn against
_SKY = {"altitude": "altitude of the star (°)", "parallactic": "parallactic angle (°)"}

# data taken with the same setting of the half-wave plate: which they are, indices on the second
# axis of the grids, and the mean position (rad) of every stage, or None if one moves
Series = namedtuple("Series", "label data positions")


class DataGrid:
    """
    One dataset as arrays of shape (n_wavelengths, n_groups), NaN where masked.

    A group is the frame, or the pair of frames, that gives one datum.
    """

    def __init__(self, calibration, dataset):
        residuals = calibration.residuals  # first: says clearly if there are no data
        measurement = calibration.measurement
        count = len(calibration.datasets)
        if isinstance(dataset, bool) or dataset not in range(count):
            raise ParameterError(
                f"dataset = {dataset!r}; allowed are whole numbers 0 to {count - 1}"
            )
        self.part = measurement.datasets[dataset]
        self.chain = calibration.chains[dataset]
        if not self.part.n_data:
            raise ObservationError(f"{self.part.observations.name}: no datum is left to draw")
        self.observable = measurement.observable
        self.wavelength = st.nanometres(self.part.observations.wavelength)
        self.observed = self._grid(self.part.observed)
        self.residual = self._grid(residuals[measurement.segments[dataset]])
        self.sigma = self._grid(self.part.sigma)
        self.calibrated_um = measurement.wavelength
        sky = [stage for stage in _SKY if stage in self.part.positions]
        self.is_star = is_star(self.part.observations.source) and bool(sky)
        # the stage by which data are grouped, and drawn where the sky does not move
        self.turning = self._turning()
        still = self.turning is None
        self.angle = np.zeros(len(self.part.frames)) if still else self.degrees(self.turning)
        # what the data are drawn against, in degree, and how that is called
        self.abscissa, self.label = self.angle, f"{_stage_words(self.turning)} (°)"
        if self.is_star:
            self.abscissa = np.rad2deg(self.position(sky[0]).mean(axis=0))
            self.label = _SKY[sky[0]]
        # whether the half-wave plate makes the series
        self.by_plate = self.turning == "derotator" or (self.is_star and "hwp" in self._still())
        # the observable in words
        self.quantity = self.observable.name.replace("_", " ")

    def _grid(self, flat):
        grid = np.full(self.part.valid.shape, np.nan)
        grid[self.part.valid] = flat
        return grid

    # ---- where the stages stand -------------------------------------------------

    def position(self, stage):
        """Return the position (rad) of a stage, shape (frames_per_datum, n_groups)."""
        # as the model has them, which need not be the table's columns
        if stage in self.part.positions:
            return self.part.positions[stage]
        return self.part.observations.position(stage)[self.part.frames.T]

    def _turning(self):
        """Return the derotator where there is one, else the stage with the most settings."""
        if "derotator" in {*self.part.positions, *self.part.observations.frame_columns}:
            return "derotator"
        counts = {stage: clusters(self.degrees(stage), SAME_ANGLE).max() for stage in self._still()}
        # of a star the plate makes the series
        counts.pop("hwp" if self.is_star else None, None)
        return max(counts, key=counts.get, default=None)

    def _still(self):
        """Return the stages whose position is an angle, without those of the sky."""
        known = [stage for stage in stages(self.chain) if stage not in COORDINATES]
        return [stage for stage in known if stage not in _SKY]

    def degrees(self, stage):
        """Return the position of a stage in the first frame of each datum."""
        return np.rad2deg(self.position(stage)[0])

    def series(self):
        """Return the data by setting of the half-wave plate, or what else sets them apart."""
        if not self.by_plate:
            return self._other_series()
        observations, frames = self.part.observations, self.part.frames
        # as commanded where it follows the sky
        plate = observations.position("hwp")[frames.T] if self.is_star else self.position("hwp")
        # half a turn does not matter; a value just below it belongs to zero
        angle = np.mod(np.rad2deg(plate) + SAME_ANGLE, 180) - SAME_ANGLE
        number, state = clusters(angle[0], SAME_ANGLE), self._state()
        settings = sorted(set(zip(number, state, strict=True)))
        found = []
        for n, now in settings:
            member = (number == n) & (state == now)
            angles = [st.degrees(value) for value in np.median(angle[:, member], axis=1)]
            # where the states of a modulator make the difference the plate is static
            still = now and len(set(angles)) == 1
            label = angles[0] if still else f" {st.MINUS} ".join(angles)
            label = f"{label}, {now}" if now else label
            found.append(Series(label, np.flatnonzero(member), self._others(member)))
        return found

    def _others(self, member):
        """Return the mean positions of all stages but the one that turns, None where one moves."""
        known = {s: a[:, member] for s, a in self.part.positions.items() if s != self.turning}
        moves = any(np.ptp(a, axis=1).max() > np.deg2rad(SAME_ANGLE) for a in known.values())
        return None if moves else {stage: a.mean(axis=1) for stage, a in known.items()}

    def _other_series(self):
        """Return the data by the settings of all stages but the one that turns."""
        table, first = self.part.observations.frames, self.part.frames[:, 0]
        labels = np.full(len(first), "", dtype=object)
        for stage in self._still():
            if stage != self.turning:
                number, angle = clusters(self.degrees(stage), SAME_ANGLE), self.degrees(stage)
                middle = [st.degrees(np.median(angle[number == n])) for n in number]
                labels += [f", {stage} {one}" for one in middle]
        devices = (stage.partition("=")[0] for stage in stages(self.chain) if "=" in stage)
        for device in dict.fromkeys(devices):
            labels += [f", {device} {state}" for state in table[device][first]]
        # states are of frames, and what a single beam shows hangs on its group
        drawn = not any(stage in COORDINATES for stage in stages(self.chain))
        drawn &= self.observable.name != "intensity"
        found = []
        for label in dict.fromkeys(labels.tolist()):
            member = labels == label
            positions = self._others(member) if drawn else None
            found.append(Series(label[2:] or "all", np.flatnonzero(member), positions))
        return found

    def _state(self):
        """Return the states of a modulator in the frames of a datum, empty without one."""
        if "flc_state" not in stages(self.chain):
            return np.full(self.part.frames.shape[0], "")
        state = self.part.observations.position("flc_state")[self.part.frames] > 0.5
        # the states of the frames, or the one that all of them have
        names = [one if len(set(one)) > 1 else one[:1] for one in np.where(state, "B", "A")]
        return np.array([f" {st.MINUS} ".join(one) for one in names])

    # ---- the model ---------------------------------------------------------------

    def curve(self, series, bins, angle):
        """
        Return the model between the data, shape (n_bins, n_angles).

        One stage turns (``angle`` in degree, that of the first frame of a datum); every other
        stays where it stands in the series.
        """
        angle = np.deg2rad(angle)
        per_datum, n = self.part.frames.shape[1], len(angle)
        positions = {stage: np.repeat(p, n) for stage, p in series.positions.items()}
        where = self.position(self.turning)[:, series.data]
        apart = np.median(where - where[0], axis=1)
        positions[self.turning] = np.tile(angle, per_datum) + np.repeat(apart, n)
        # between the data there is neither a time nor a flux: such optics do nothing there
        positions |= {stage: np.full(1, x.value) for stage, x in standing(self.chain).items()}
        if "flc_state" in stages(self.chain):
            state = self.part.observations.position("flc_state")
            positions["flc_state"] = np.repeat(state[self.part.frames[series.data[0]]], n)
        # the chain's parameters are given on the calibration's own grid of wavelengths
        propagator = Propagator(self.chain, self.calibrated_um, positions)
        right, left = (
            flux[self.part.bins[bins]].reshape(len(bins), per_datum, n).transpose(1, 0, 2)
            for flux in propagator.fluxes()
        )
        return self.observable.evaluate(right, left)

    # ---- wavelengths ---------------------------------------------------------------

    def spread_bins(self, count):
        """Return bins with data, spread over the range."""
        usable = np.flatnonzero(np.isfinite(self.observed).any(axis=1))
        usable = usable[np.argsort(self.wavelength[usable])]
        if len(usable) <= count:
            return usable
        # few wavelengths leave nothing between them to be spread over
        ends = 1 if len(usable) > 2 * count else 0
        places = np.linspace(0, len(usable) - 1, count + 2 * ends)[ends : ends + count]
        return usable[np.round(places).astype(int)]

    def nearest_bins(self, wavelengths):
        """Return the bins nearest to wavelengths, each once."""
        wanted = st.nanometres(wavelengths)
        low, high = self.wavelength.min(), self.wavelength.max()
        for value in wanted:
            if not 0.99 * low <= value <= 1.01 * high:
                raise WavelengthRangeError(
                    f"wavelength {value:g} nm; {self.part.observations.name} has "
                    f"{low:.1f} to {high:.1f} nm"
                )
        nearest = np.abs(self.wavelength[None, :] - wanted[:, None]).argmin(axis=1)
        return np.array(list(dict.fromkeys(nearest.tolist())))


# ---- observed and modelled differences ------------------------------------------------------


def plot_double_differences(calibration, wavelengths=None, dataset=0, *, figure=None):
    """
    Draw observed and modelled differences against the derotator angle, or a star's altitude.

    One pair of panels per wavelength: above the observed data and the model, evaluated between the
    data too; below their difference in percent. Stars are drawn against their altitude, or the
    parallactic angle without one, by the commanded angle of the half-wave plate. Without a
    derotator the stage with the most settings takes its place. Where another stage moves within a
    series, the model is drawn at the data only.

    Parameters
    ----------
    calibration : Calibration
        A calibration that still has its data.
    wavelengths : `~astropy.units.Quantity`, optional
        The nearest wavelengths of the data are shown; by default four.
    dataset : int
        Which of the calibration's datasets.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file, which holds no data.
    ParameterError, WavelengthRangeError
        If there is no such dataset, or a wavelength outside its range.
    ObservationError
        If every datum of the dataset is masked.

    Notes
    -----
    The figure of double differences of McIntosh et al. (2026), with residuals.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.plotting import plot_double_differences
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(plot_double_differences(cal, [1330, 1575] * u.nm).axes)
    4
    """
    drawn = DataGrid(calibration, dataset)
    bins = drawn.spread_bins(4) if wavelengths is None else drawn.nearest_bins(wavelengths)
    series = drawn.series()
    columns = min(2, len(bins))
    rows = -(-len(bins) // columns)
    # as high as a legend of all settings beside the panels, and a title above it
    height = max(1.2 + 4.1 * rows, 2.2 + 0.24 * len(series))
    with st.canvas(figure, 3.0 + 4.4 * columns, height) as figure:
        pairs = _panels(figure, len(bins), rows, columns)
        # the curve goes a little beyond the data, ten degrees around a single angle
        low, high = drawn.abscissa.min(), drawn.abscissa.max()
        margin = 0.04 * (high - low) if high - low > 1 else 10
        # so many points that a curve over 180 deg has no corners
        fine = np.linspace(low - margin, high + margin, 241)
        curves = [None if one.positions is None else drawn.curve(one, bins, fine) for one in series]
        spread = calibration.datasets[dataset].accuracy["s_res"].to_value(u.percent)
        for i, (pair, row) in enumerate(zip(pairs, bins, strict=True)):
            wavelength, s_res, (top, bottom) = drawn.wavelength[row], spread[row], pair
            bottom.axhline(0, color=st.GREY, linewidth=1)
            known = np.isfinite(s_res)
            top.set_title(f"{wavelength:.1f} nm" + (f",  s_res = {s_res:.2f} %" if known else ""))
            if known:
                bottom.axhspan(-s_res, s_res, color="0.92", zorder=0)
            for one, curve, look in zip(series, curves, _looks(len(series)), strict=True):
                angle, points = drawn.abscissa[one.data], look | {"linestyle": "none"}
                value, residual, sigma = (
                    a[row, one.data] for a in (drawn.observed, drawn.residual, drawn.sigma)
                )
                # bars of length zero would look like errors that are very small
                bars = np.nan_to_num(sigma) if np.isfinite(sigma).any() else None
                percent = bars if bars is None else 100 * bars
                top.errorbar(angle, value, yerr=bars, label=one.label, **points)
                bottom.errorbar(angle, 100 * residual, yerr=percent, label=one.label, **points)
                if curve is not None:
                    top.plot(fine, curve[i], color=look["color"], linestyle=look["linestyle"])
                else:
                    # where a stage moves from datum to datum there is no model between the data
                    top.plot(angle, value - residual, "x", color=look["color"], markersize=8)
        pairs[0][0].set_xlim(fine[0], fine[-1])
        _label(pairs, drawn, columns)
        st.heading(figure, calibration, drawn.quantity.capitalize(), [drawn.part.observations.name])
        _legend(figure, drawn, series, bins, spread[bins])
    return figure


def _stage_words(stage):
    """Return what the angle of a stage is called."""
    return {"hwp": "half-wave plate angle"}.get(stage, f"{stage} angle")


def _panels(figure, count, rows, columns):
    """Return (data, residual) axes for each wavelength, all with the same scales."""
    # residuals need less height than data
    spec = figure.add_gridspec(2 * rows, columns, height_ratios=(3, 1.5) * rows)
    pairs = []
    for i in range(count):
        row, column = divmod(i, columns)
        first = pairs[0] if pairs else (None, None)
        top = figure.add_subplot(spec[2 * row, column], sharex=first[0], sharey=first[0])
        bottom = figure.add_subplot(spec[2 * row + 1, column], sharex=top, sharey=first[1])
        pairs.append((top, bottom))
    return pairs


def _looks(count):
    """Return the looks of the series: where colours recur, lines are dashed and markers open."""
    pairs = zip(st.looks(count), np.arange(count) // len(st.COLORS) % 2, strict=True)
    return [
        {"color": color, "marker": marker}
        | {"markerfacecolor": "white" if again else color, "linestyle": "--" if again else "-"}
        for (color, marker), again in pairs
    ]


def _label(pairs, grid, columns):
    for i, (top, bottom) in enumerate(pairs):
        last, first = i + columns >= len(pairs), i % columns == 0
        top.tick_params(labelbottom=False, labelleft=first)
        bottom.tick_params(labelbottom=last, labelleft=first)
        if last:
            bottom.set_xlabel(grid.label)
        if first:
            top.set_ylabel(grid.quantity.replace(" ", "\n", 1))
            bottom.set_ylabel(f"obs. {st.MINUS} model\n(%)")


def _legend(figure, grid, series, bins, s_res):
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def entry(label, marker="", line=""):
        return Line2D([], [], color=st.GREY, marker=marker, linestyle=line, label=label)

    # what is not drawn has no entry in the legend
    curves = any(one.positions is not None for one in series)
    handles = [
        Line2D([], [], **(look if curves else look | {"linestyle": ""}), label=one.label)
        for one, look in zip(series, _looks(len(series)), strict=True)
    ]
    bars = np.isfinite(grid.sigma[bins]).any()
    seen = f"observed, with 1{st.SIGMA} errors" if bars else "observed (no errors given)"
    handles.append(entry(seen, "o"))
    handles += [entry("model", line="-")] if curves else []
    if any(one.positions is None for one in series):
        handles.append(entry("model at data", "x"))
    if np.isfinite(s_res).any():
        handles.append(Patch(color="0.92", label="± s_res"))
    frames = f"plus {st.MINUS} minus frame" if grid.part.frames.shape[1] == 2 else "of the frame"
    plate = "half-wave plate\nas commanded" if grid.is_star else "half-wave plate"
    plate = plate if grid.by_plate else "settings"
    # at the top a long title would run into it
    place = "outside right center"
    st.legend_outside(figure, handles, place=place, title=f"{plate},\n{frames}")


# ---- maps of the residuals -------------------------------------------------------------------
# share of the residuals that the colour scale covers, so that one outlier does not blank the map
_COVERED = 99
# room above the tallest bar
_HEADROOM = 1.05


def plot_residuals(calibration, *, figure=None):
    """Draw a map of the residuals: wavelength against datum, by derotator angle; one per dataset.

    Above it stands the rms of each datum, at its right that of each wavelength. All maps have the
    same colours, or where the residuals differ much in size each its own. Grey is what is masked,
    and of single beams the frame with which a group begins. Datasets of one wavelength each are
    bars. The calibration needs its data.
    """
    grids = [DataGrid(calibration, i) for i in range(len(calibration.datasets))]
    count = len(grids)
    bars = all(grid.wavelength.size == 1 for grid in grids)
    height = 2.2 + 1.4 * max(count, 2) if bars else 0.8 + 5.4 * count
    with st.canvas(figure, 10.5, height) as figure:
        (_draw_bars if bars else _draw_maps)(figure, grids)
        names = [grid.part.observations.name for grid in grids]
        st.heading(figure, calibration, f"Residuals of the {grids[0].quantity}", names)
    return figure


def _draw_maps(figure, grids):
    scales, shared = _scales(grids)
    n = len(grids)
    spec = figure.add_gridspec(2 * n, 2, width_ratios=(5, 1), height_ratios=(1, 3.6) * n)
    for i, (grid, (limit, clipped)) in enumerate(zip(grids, scales, strict=True)):
        main = figure.add_subplot(spec[2 * i + 1, 0])
        above = figure.add_subplot(spec[2 * i, 0], sharex=main)
        right = figure.add_subplot(spec[2 * i + 1, 1], sharey=main)
        drawn = _draw_dataset(main, above, right, grid, limit)
        if n > 1:
            above.set_title(grid.part.observations.name, loc="left")
        if not shared:
            st.color_bar(figure, drawn, [main, above, right], clipped, ", own scale\n")
    if shared:
        st.color_bar(figure, drawn, figure.axes, clipped)


def _scales(grids):
    """Return colour scale of each map, whether data lie beyond it, and if it is that of all."""
    residuals = [100 * grid.residual.ravel() for grid in grids]
    own = [st.color_limit(one, _COVERED) for one in residuals]
    ends = [limit for limit, _ in own]
    # maps have one scale unless those of their own differ by more than this factor
    if max(ends) > 3 * min(ends):
        return own, False
    return [st.color_limit(np.concatenate(residuals), _COVERED)] * len(grids), True


def _draw_bars(figure, grids):
    """Draw the residuals at one wavelength, a panel per dataset, all with the same scale."""
    panels = figure.subplots(len(grids), 1, sharey=True, squeeze=False)[:, 0]
    below = None
    for axes, grid in list(zip(panels, grids, strict=True))[::-1]:
        order, _, ends = _layout(grid)
        percent = 100 * grid.residual[0, order]
        axes.bar(np.arange(len(order)) + 0.5, percent, width=0.9, color=st.BLUE)
        for masked in np.flatnonzero(~np.isfinite(percent)):
            axes.axvspan(masked, masked + 1, color="0.75", linewidth=0)
        axes.axhline(0, color=st.GREY, linewidth=1)
        for end in ends[:-1]:
            axes.axvline(end, color="black", linewidth=0.8)
        axes.set_xlim(0, len(order))
        size = f"{grid.wavelength[0]:.1f} nm, rms {st.rms(percent):.2g} %"
        axes.set_title(f"{grid.part.observations.name}: {size}", loc="left", fontsize=10)
        _name_axis(axes, grid)
        # what stands below the next panel need not be said twice
        words = axes.get_xlabel(), [text.get_text() for text in axes.get_xticklabels()]
        if words == below:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
        below = words
    figure.supylabel(f"observed {st.MINUS} model (%); grey: no datum", fontsize=11)
    size = max(100 * _HEADROOM * max(np.nanmax(np.abs(grid.residual)) for grid in grids), 1e-12)
    panels[0].set_ylim(-size, size)


def _draw_dataset(main, above, right, grid, limit):
    order, _, ends = _layout(grid)
    percent = 100 * grid.residual[:, order]
    drawn = st.draw_map(main, percent, grid.wavelength, limit)
    main.vlines(ends[:-1], *main.get_ylim(), color="black", linewidth=0.8)
    _name_axis(main, grid)
    above.stairs(st.rms(percent, axis=0), np.arange(len(order) + 1), color=st.BLUE, fill=True)
    above.tick_params(labelbottom=False)
    above.set_ylabel("rms (%)")
    lam, each = np.argsort(grid.wavelength), st.rms(percent, axis=1)
    right.plot(each[lam], grid.wavelength[lam], "o-", color=st.BLUE)
    right.set_xlabel("rms (%)")
    right.tick_params(labelleft=False)
    for axes in (above, right):
        axes.margins(0)
    # exact data have no bars
    above.set_ylim(0, _HEADROOM * np.nanmax(st.rms(percent, axis=0)) or 1)
    right.set_xlim(0, 1.1 * np.nanmax(each) or 1)
    return drawn


def _layout(grid):
    """Return the data by derotator then half-wave plate angle, groups, and where these end."""
    turning = clusters(grid.angle, SAME_ANGLE)
    # number of the setting of the plate of each datum
    plate = np.empty(len(turning), dtype=int)
    for i, series in enumerate(grid.series()):
        plate[series.data] = i
    # the last key is the first: by derotator angle, within it by plate
    order = np.lexsort((plate, turning))
    group = turning[order]
    ends = np.flatnonzero(np.diff(group, append=group[-1] + 1)) + 1
    return order, group, ends


def _name_axis(axes, grid):
    order, group, ends = _layout(grid)
    angles = [st.degrees(np.median(grid.angle[order][group == g])) for g in range(len(ends))]
    labels = [series.label for series in grid.series()]
    within = ", ".join(labels) if len(labels) <= 8 else f"{labels[0]} to {labels[-1]}"
    words = [_stage_words(grid.turning)] if grid.turning else []
    if len(labels) > 1:
        plate = "half-wave plate at" if grid.by_plate else "settings"
        words.append(f"{'at each, ' if words else ''}left to right, {plate}\n{within}")
    st.name_groups(axes, ends, angles if grid.turning else [""], "; ".join(words))
