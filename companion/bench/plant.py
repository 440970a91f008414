"""What the benchmark flies: a vehicle that answers late, ranges that err, and the bound of every path.

Independent of `companion.guidance.model` but for the length of the shortest path: the pose is integrated in
small steps, and the lift is not used. Plain functions over NamedTuples, with NumPy's seeded random numbers;
`batch.py` compiles them with numba as they stand, together with the guidance that they fly.

Every random number is drawn whether it is needed or not and from the flight's own seed, so that for the same
seed all schemes meet the same start, wind, noise, dropouts and outliers at the same moments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from companion.guidance.model import clip, shortest_path_m
from companion.guidance.scheme import REST
from sitl_mock.estimate import Spread

STEP_S = 1.0 / 60.0
RANGE_STEPS = 3
"""A range and a command every so many steps: 20 Hz."""
TELEMETRY_STEPS = 2
"""Where the vehicle reports its motion: every so many steps, 30 Hz."""
LONGEST_DEAD_STEPS = 60
REST_S = 3.0
"""A scheme that asked for rest for so long has decided to stay: there its stop is judged, as `companion sim`
does."""
PATIENCE_S = 60.0
"""A scheme that does not come to rest within this time after the capture never does."""
NO_ERROR = Spread(0.0, 0.0, 1.0)


class Plant(NamedTuple):
    """One kind of flight; the defaults are the nominal one.

    Ranges: noise `sigma_m`, probability of none (`dropout`) and of a reflection that adds 0.5 to 3 m
    (`reflected`), a constant `range_bias_m`, silence for `outage_s` in every `outage_every_s`.

    Vehicle: the yaw rate follows its command after `yaw_rate_dead_s` with a first-order lag, the speed with
    another. With `slips` the lag is on the velocity as a vector, as a multicopter's is, so that in a turn it
    flies sideways; else the vehicle moves where it looks. It flies `speed_scale` times as fast and turns by
    `gyro_bias_rad_s` more than it should (to either side, drawn for each flight), in a wind of `drift_m_s`
    from anywhere.

    Telemetry: with `reports` the scheme is told the motion that the autopilot measures, at 30 Hz and in the
    way of `companion.pilot`, else the one modelled from the commands with the right lags. The autopilot
    regulates its own estimate, so its errors (estimate − truth: position, velocity, heading, height)
    show in the truth.

    The vehicle is `height_m` above the beacon and believes itself `height_error_m` higher, with the sigma
    `height_sigma_m`.
    """

    radius_m: float = 0.5
    speed_m_s: float = 0.5
    yaw_rate_max_rad_s: float = 1.0
    sigma_m: float = 0.07
    dropout: float = 0.1
    reflected: float = 0.05
    range_bias_m: float = 0.0
    outage_s: float = 0.0
    outage_every_s: float = 20.0
    yaw_rate_lag_s: float = 0.2
    yaw_rate_dead_s: float = 0.0
    velocity_lag_s: float = 0.3
    slips: bool = False
    speed_scale: float = 1.0
    gyro_bias_rad_s: float = 0.0
    drift_m_s: float = 0.0
    reports: bool = False
    position_error: Spread = NO_ERROR
    velocity_error: Spread = NO_ERROR
    heading_error: Spread = NO_ERROR
    height_wander: Spread = NO_ERROR
    yaw_rate_noise_rad_s: float = 0.0
    height_m: float = 0.0
    height_error_m: float = 0.0
    height_sigma_m: float = 0.1
    limit_s: float = 300.0


class Start(NamedTuple):
    """Horizontal distance, bearing θ, and the seed of everything random."""

    d_m: float
    theta_rad: float
    seed: int


class Truth(NamedTuple):
    """What only a limit of the benchmark is told: true distance, bearing and drift in body axes."""

    d_m: float
    theta_rad: float
    drift_forward_m_s: float
    drift_left_m_s: float


class Flight(NamedTuple):
    """One flight, judged by the truth.

    Up to the first moment within the radius (infinite: never): the time, the length of the path through the
    air, ∫|ω| dt and ∫ω² dt. `bound_m` is the shortest path that the turn bound allows, with the drift known.
    `rest_m` is the horizontal distance at which the scheme's own stop left the vehicle (infinite: it did not
    stop).
    """

    time_s: float
    path_m: float
    bound_m: float
    rest_m: float
    turned_rad: float
    effort: float


class Sample(NamedTuple):
    """One line of a trace: the true state when a command was given, the command, and what the scheme knew.

    The frame has its origin at the start and its x axis along the first heading. `rate_m_s` is ḋ."""

    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    d_m: float
    rate_m_s: float
    v_m_s: float
    omega_rad_s: float
    commanded_v_m_s: float
    commanded_omega_rad_s: float
    purpose: float


# ----------------------------------------------------------------------------------------------- errors


class Wander(NamedTuple):
    """A constant and a smooth random process: white noise through two equal lags, as in
    `sitl_mock.estimate`."""

    value: float
    first: float
    second: float
    constant: float


def wander_start(spread: Spread) -> Wander:
    """A draw from the stationary process."""
    sigma = spread.varying * math.sqrt(2.0)
    first = np.random.normal(0.0, 1.0) * sigma
    second = 0.5 * first + np.random.normal(0.0, 1.0) * 0.5 * sigma
    constant = np.random.normal(0.0, 1.0) * spread.constant
    return Wander(constant + second, first, second, constant)


def wander_step(w: Wander, spread: Spread, dt_s: float) -> Wander:
    """The process dt_s later."""
    decay = math.exp(-dt_s / spread.tau_s)
    second = w.second + (1.0 - decay) * (w.first - w.second)
    noise = spread.varying * math.sqrt(2.0 * (1.0 - decay * decay))
    first = decay * w.first + noise * np.random.normal(0.0, 1.0)
    return Wander(w.constant + second, first, second, w.constant)


class Errors(NamedTuple):
    """Estimate − truth of the autopilot: position and velocity along x and y, heading, height."""

    x: Wander
    y: Wander
    vx: Wander
    vy: Wander
    heading: Wander
    height: Wander


def errors_start(plant: Plant) -> Errors:
    """At the start of a flight."""
    return Errors(
        wander_start(plant.position_error),
        wander_start(plant.position_error),
        wander_start(plant.velocity_error),
        wander_start(plant.velocity_error),
        wander_start(plant.heading_error),
        wander_start(plant.height_wander),
    )


def errors_step(e: Errors, plant: Plant, dt_s: float) -> Errors:
    """dt_s later."""
    return Errors(
        wander_step(e.x, plant.position_error, dt_s),
        wander_step(e.y, plant.position_error, dt_s),
        wander_step(e.vx, plant.velocity_error, dt_s),
        wander_step(e.vy, plant.velocity_error, dt_s),
        wander_step(e.heading, plant.heading_error, dt_s),
        wander_step(e.height, plant.height_wander, dt_s),
    )


def heard(plant: Plant, true_range_m: float, silent: bool) -> float:
    """The range measured now, −1 where there is none."""
    lost = np.random.random() < plant.dropout
    noise_m = plant.sigma_m * np.random.normal(0.0, 1.0)
    reflects = np.random.random() < plant.reflected
    detour_m = np.random.uniform(0.5, 3.0)
    if lost or silent:
        return -1.0
    return max(true_range_m + plant.range_bias_m + noise_m + (detour_m if reflects else 0.0), 0.0)


# ------------------------------------------------------------------------------------------------ bound


def shortest_time_s(
    d_m: float,
    theta_rad: float,
    radius_m: float,
    v_m_s: float,
    omega_rad_s: float,
    drift_forward_m_s: float,
    drift_left_m_s: float,
) -> float:
    """Zermelo's problem with a turn bound: the least time to reach the disc in a known, constant wind.

    The wind (body axes at the start) carries the vehicle, or, seen from the air, the disc the other way. The
    vehicle flies at v through the air, v greater than the wind. T is the first moment at which the shortest
    path to the disc, as it then lies, is no longer than v T: before that moment no steering reaches it. (Only
    where the shortest path jumps, at a disc that has just left a turning circle, may the vehicle be there
    early and have to wait: then T is a bound that no steering attains.)

    As the disc moves at |w|, the shortest path shrinks no faster than v + |w|: steps by that rate cannot pass
    the moment. They are no longer than the disc needs to move by a quarter of its radius, so that no jump is
    missed; one that was stepped over is found by bisection.
    """
    wind = math.hypot(drift_forward_m_s, drift_left_m_s)
    ahead = d_m * math.cos(theta_rad)
    left = -d_m * math.sin(theta_rad)
    before = t = 0.0
    limit_s = 1e4
    while t < limit_s:
        x, y = ahead - drift_forward_m_s * t, left - drift_left_m_s * t
        lacks = shortest_path_m(math.hypot(x, y), math.atan2(-y, x), radius_m, v_m_s, omega_rad_s) - v_m_s * t
        if lacks <= 0.0:
            break
        if lacks < 1e-9:
            return t
        before = t
        step = lacks / (v_m_s + wind)
        t += step if wind == 0.0 else min(step, 0.25 * radius_m / wind)
    while t - before > 1e-9:
        middle = 0.5 * (before + t)
        x, y = ahead - drift_forward_m_s * middle, left - drift_left_m_s * middle
        path = shortest_path_m(math.hypot(x, y), math.atan2(-y, x), radius_m, v_m_s, omega_rad_s)
        if path <= v_m_s * middle:
            t = middle
        else:
            before = middle
    return t


# ----------------------------------------------------------------------------------------------- flight


class Body(NamedTuple):
    """The vehicle in truth, and the motion and heading that its autopilot estimates."""

    x: float
    y: float
    heading: float
    omega: float
    speed: float
    vx: float
    vy: float


def moved(b: Body, plant: Plant, v: float, omega: float, bias: float, heading_error: float) -> Body:
    """One step on: commanded speed v and yaw rate omega. The ground velocity is the caller's business."""
    omega_now = omega + (b.omega - omega) * keep(plant.yaw_rate_lag_s)
    turned = (0.5 * (b.omega + omega_now) + bias) * STEP_S
    middle = b.heading + 0.5 * turned
    k = keep(plant.velocity_lag_s)
    speed = v + (b.speed - v) * k
    if plant.slips:
        # the setpoint is turned by the heading that the autopilot believes
        ux, uy = v * math.cos(middle + heading_error), v * math.sin(middle + heading_error)
        vx, vy = ux + (b.vx - ux) * k, uy + (b.vy - uy) * k
    else:
        vx, vy = speed * math.cos(middle), speed * math.sin(middle)
    return Body(b.x, b.y, b.heading + turned, omega_now, speed, vx, vy)


def keep(lag_s: float) -> float:
    """What a first-order lag keeps over one step."""
    return math.exp(-STEP_S / lag_s) if lag_s > 0.0 else 0.0


def lagged(value: float, towards: float, dt_s: float, lag_s: float) -> float:
    """The app's own model of a lag, where nothing is reported."""
    return towards + (value - towards) * math.exp(-dt_s / lag_s) if lag_s > 0.0 else towards


def untold(s: Any, truth: Truth) -> Any:
    """Whoever flies is not told the truth."""
    return s


def fly(
    initial: Callable[..., Any],
    predict: Callable[..., Any],
    update: Callable[..., Any],
    command: Callable[..., Any],
    tell: Callable[..., Any],
    p: Any,
    plant: Plant,
    start: Start,
    trace: np.ndarray[Any, np.dtype[np.float64]],
) -> Flight:
    """Fly a scheme (its functions and parameters) once; `trace` takes one `Sample` a line while it has
    room."""
    np.random.seed(start.seed)
    wind_from = np.random.uniform(-math.pi, math.pi)
    drift_x, drift_y = plant.drift_m_s * math.cos(wind_from), plant.drift_m_s * math.sin(wind_from)
    bias = math.copysign(plant.gyro_bias_rad_s, np.random.uniform(-1.0, 1.0))
    silent_from = np.random.uniform(0.0, plant.outage_every_s)
    errors = errors_start(plant)

    bound_m = plant.speed_m_s * shortest_time_s(
        start.d_m,
        start.theta_rad,
        plant.radius_m,
        plant.speed_m_s,
        plant.yaw_rate_max_rad_s,
        drift_x,
        drift_y,
    )
    tx, ty = start.d_m * math.cos(start.theta_rad), -start.d_m * math.sin(start.theta_rad)
    b = Body(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    d = start.d_m
    gx = gy = 0.0
    dead = np.zeros(LONGEST_DEAD_STEPS)
    dead_steps = round(plant.yaw_rate_dead_s / STEP_S)
    forward = left = yaw_rate = since_s = 0.0
    turned_to = errors.heading.value
    told_x, told_y = errors.x.value, errors.y.value
    v = omega = 0.0
    path_m = turned_rad = effort = rested_s = 0.0
    time_s = rest_m = math.inf
    s = initial(p)
    for k in range(int(plant.limit_s / STEP_S)):
        t_s = k * STEP_S
        if plant.reports and k % TELEMETRY_STEPS == 0:
            if k > 0:
                errors = errors_step(errors, plant, TELEMETRY_STEPS * STEP_S)
            seen = b.heading + errors.heading.value
            seen_x, seen_y = b.x + errors.x.value, b.y + errors.y.value
            # as in the app, the turn is that of the measured headings, the move that of the measured
            # positions, and in between both go on as the last message said
            if t_s > since_s:
                dt_s = t_s - since_s
                c, sn = math.cos(0.5 * (seen + turned_to)), math.sin(0.5 * (seen + turned_to))
                dx, dy = seen_x - told_x, seen_y - told_y
                s = predict(
                    p,
                    s,
                    dt_s,
                    (dx * c + dy * sn) / dt_s,
                    (dy * c - dx * sn) / dt_s,
                    (seen - turned_to) / dt_s,
                )
            since_s, turned_to, told_x, told_y = t_s, seen, seen_x, seen_y
            forward = b.vx * math.cos(seen) + b.vy * math.sin(seen)
            left = b.vy * math.cos(seen) - b.vx * math.sin(seen)
            yaw_rate = b.omega + plant.yaw_rate_noise_rad_s * np.random.normal(0.0, 1.0)
        if k % RANGE_STEPS == 0:
            if not plant.reports:
                dt_s = t_s - since_s
                forward_before, yaw_rate_before = forward, yaw_rate
                forward = lagged(forward, v, dt_s, plant.velocity_lag_s)
                yaw_rate = lagged(yaw_rate, omega, dt_s, plant.yaw_rate_lag_s)
                if t_s > since_s:
                    s = predict(
                        p, s, dt_s, 0.5 * (forward_before + forward), left, 0.5 * (yaw_rate_before + yaw_rate)
                    )
            elif t_s > since_s:
                dt_s = t_s - since_s
                s = predict(p, s, dt_s, forward, left, yaw_rate)
                c, sn = (
                    math.cos(turned_to + 0.5 * yaw_rate * dt_s),
                    math.sin(turned_to + 0.5 * yaw_rate * dt_s),
                )
                told_x += (forward * c - left * sn) * dt_s
                told_y += (forward * sn + left * c) * dt_s
                turned_to += yaw_rate * dt_s
            since_s = t_s
            silent = (t_s + silent_from) % plant.outage_every_s < plant.outage_s
            r = heard(plant, math.hypot(d, plant.height_m - errors.height.value), silent)
            if r >= 0.0:
                dh_m = plant.height_m + plant.height_error_m
                s = update(p, s, 0, r, plant.sigma_m, dh_m, plant.height_sigma_m)
            c, sn = math.cos(b.heading), math.sin(b.heading)
            theta = math.atan2((tx - b.x) * sn - (ty - b.y) * c, (tx - b.x) * c + (ty - b.y) * sn)
            s = tell(s, Truth(d, theta, drift_x * c + drift_y * sn, drift_y * c - drift_x * sn))
            s, u = command(p, s, RANGE_STEPS * STEP_S, yaw_rate)
            v = max(0.0, min(u.v_m_s, plant.speed_m_s))
            omega = clip(u.omega_rad_s, plant.yaw_rate_max_rad_s)
            line = k // RANGE_STEPS
            if line < len(trace):
                rate = -(gx * (tx - b.x) + gy * (ty - b.y)) / max(d, 1e-9)
                air = math.hypot(b.vx, b.vy)
                sample = Sample(
                    t_s, b.x, b.y, b.heading, d, rate, air, b.omega + bias, v, omega, float(u.purpose)
                )
                for i, value in enumerate(sample):
                    trace[line, i] = value
            rested_s = rested_s + RANGE_STEPS * STEP_S if u.purpose == REST else 0.0
            if rested_s > REST_S and rest_m == math.inf:
                rest_m = d
            if time_s < math.inf and (rest_m < math.inf or t_s > time_s + PATIENCE_S):
                break
        # the yaw rate commanded a dead time ago
        dead[k % LONGEST_DEAD_STEPS] = omega
        acts = dead[(k - dead_steps) % LONGEST_DEAD_STEPS] if k >= dead_steps else 0.0
        omega_before = b.omega
        b = moved(b, plant, v, acts, bias, errors.heading.value)
        air_x = plant.speed_scale * b.vx - errors.vx.value
        air_y = plant.speed_scale * b.vy - errors.vy.value
        gx, gy = air_x + drift_x, air_y + drift_y
        b = Body(b.x + gx * STEP_S, b.y + gy * STEP_S, b.heading, b.omega, b.speed, b.vx, b.vy)
        d_before = d
        d = math.hypot(tx - b.x, ty - b.y)
        if time_s == math.inf:
            share = 1.0
            if d <= plant.radius_m:
                share = clip((d_before - plant.radius_m) / max(d_before - d, 1e-12), 1.0)
                time_s = t_s + share * STEP_S
            rate = 0.5 * (omega_before + b.omega) + bias
            path_m += share * math.hypot(air_x, air_y) * STEP_S
            turned_rad += share * abs(rate) * STEP_S
            effort += share * rate * rate * STEP_S
    return Flight(time_s, path_m if time_s < math.inf else math.inf, bound_m, rest_m, turned_rad, effort)
