"""One step of splats that are fitted to pictures: the view that is due, and Adam on the values, in one pass."""

# Kingma and Ba, "Adam" (2015), on the slopes of splats/project_slopes, with the regularisers and the noise of
# Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo" (2024): mean opacity and mean scale are losses,
# and a splat that is almost nothing wanders, x += S xi noise / (1 + exp(100 (o - 0.005))), xi normal, S its covariance.
# Lengths are in units in which cameras are 1 from what they look at: noise and the loss of scales depend on them. All
# that changes from step to step lies on the device, so that a graph replays the steps without the host.

import warp as wp

from ..core.lanes import grid_place
from ..field.harmonics import sh_basis
from ..splats.fit import write_splat
from ..splats.pose import covariance_of
from ..splats.project import Lens
from ..splats.project_slopes import SplatValues, row_slopes
from ..splats.splats import Splats
from .batches import Pictures, picture_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Opacity about which splats begin to wander, how sharply, and above which none does.
DEAD_OPACITY = wp.constant(0.005)

SHARPNESS = wp.constant(100.0)

STILL_OPACITY = wp.constant(0.15)


@wp.struct
class SplatStep:
    """What a step does."""

    view: int  # number of the picture
    seed: int  # of the noise
    every: int  # 1: values that the picture does not see step too, as Adam is written
    background: wp.vec3  # behind the splats
    rate_centers: float
    rate_log_scales: float
    rate_quaternions: float
    rate_logits: float
    rate_colors: float  # of harmonics of degree 0
    rate_harmonics: float  # of the others
    rate_exposure: float  # of the picture's gains and offsets
    beta1: float
    beta2: float
    epsilon: float
    mean_factor: float  # 1 / (1 - beta1^t)
    root_factor: float  # 1 / sqrt(1 - beta2^t)
    opacity_weight: float  # of the sum of opacities: the weight of their mean over their number
    scale_weight: float  # of the sum of scales
    noise: float  # rate of centers times what the noise is relative to it
    most_log_scale: float  # scales are held at most at this
    most_elongation: float  # of the longest axis over the middle one, beyond which it is a loss; 0: none
    elongation_weight: float  # of the sum of what is beyond


@wp.struct
class Exposures:
    """How pictures differ from the splats: exp(gain) light + alpha offset, premultiplied. Without rows none do."""

    values: wp.array2d(dtype=wp.vec3)  # (views, 2) logarithms of gains, and offsets
    means: wp.array2d(dtype=wp.vec3)
    squares: wp.array2d(dtype=wp.vec3)
    steps: wp.array(dtype=wp.int32)  # (views,) of each picture


@wp.kernel
def begin_step(
    first: int,
    plan: wp.array(dtype=SplatStep),
    lenses: wp.array(dtype=Lens),
    counter: wp.array(dtype=wp.int32),
    step: wp.array(dtype=SplatStep),
    lens: wp.array(dtype=Lens),
):
    """One item. plan: (steps,). lenses: of each picture. counter: (1,) steps begun, goes on by one. step, lens: (1,) of
    this step."""
    if first + wp.tid() > 0:
        return
    number = wp.min(counter[0], plan.shape[0] - 1)
    step[0] = plan[number]
    lens[0] = lenses[plan[number].view]
    counter[0] = number + 1


@wp.kernel
def check_room(
    first: int,
    count: int,
    room: int,
    ends: wp.array(dtype=wp.int64),
    most: wp.array(dtype=wp.int64),
    missed: wp.array(dtype=wp.int32),
):
    """One item. ends: (count,) running sums of entries, of which `room` can be kept. most: (1,) entries of any step
    yet. missed: (2,) 1 where this step has more, and the number of such steps."""
    if first + wp.tid() > 0:
        return
    total = ends[count - 1]
    most[0] = wp.max(most[0], total)
    missed[0] = wp.where(total > wp.int64(room), 1, 0)
    missed[1] = missed[1] + missed[0]


@wp.func
def exposure_gain(exposures: Exposures, view: int):
    """Factors on the light of a picture."""
    logs = exposures.values[view, 0]
    return wp.vec3(wp.exp(logs[0]), wp.exp(logs[1]), wp.exp(logs[2]))


@wp.func
def unexposed_background(exposures: Exposures, view: int, behind: wp.vec3):
    """The color behind the splats with which gain * drawn + offset has `behind` there: no picture exposes that."""
    return wp.cw_div(behind - exposures.values[view, 1], exposure_gain(exposures, view))


@wp.kernel
def take_picture(
    first: int,
    width: int,
    pictures: Pictures,
    step: wp.array(dtype=SplatStep),
    exposures: Exposures,
    counted: wp.array3d(dtype=wp.uint8),
    alpha: wp.array(dtype=wp.float32),
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    shown: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
):
    """truth: (h * width,) the step's picture before its background. drawn: (h * width,) of opacity `alpha`, gets that
    background too."""
    # shown: as exposed, not written without exposures. counted: (views, h, width) in 1/255, which goes to
    # `weights`, or empty
    n = first + wp.tid()
    view = step[0].view
    behind = step[0].background
    pixel = picture_pixel(pictures, view, n // width, n % width)
    truth[n] = wp.vec3(pixel[0], pixel[1], pixel[2]) + (1.0 - pixel[3]) * behind
    if exposures.values.shape[0] > 0:
        behind = unexposed_background(exposures, view, behind)
    color = drawn[n] + (1.0 - alpha[n]) * behind
    drawn[n] = color
    if exposures.values.shape[0] > 0:
        shown[n] = wp.cw_mul(exposure_gain(exposures, view), color) + exposures.values[view, 1]
    if counted.shape[0] > 0:
        weights[n] = float(counted[view, n // width, n % width]) / 255.0


@wp.kernel
def sum_exposure_slopes(
    first: int,
    lanes: int,
    step: wp.array(dtype=SplatStep),
    exposures: Exposures,
    alpha: wp.array(dtype=wp.float32),
    drawn: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    sums: wp.array2d(dtype=wp.vec3),
):
    """slopes: (pixels,) by what was shown, become those by what was drawn. sums: (lanes, 2) of the slopes by gains and
    offsets over every `lanes`th pixel, one item each."""
    lane = first + wp.tid()
    view = step[0].view
    gain = exposure_gain(exposures, view)
    behind = unexposed_background(exposures, view, step[0].background)
    by_gain = wp.vec3()
    by_offset = wp.vec3()
    n = lane
    while n < slopes.shape[0]:
        by_drawn = wp.cw_mul(gain, slopes[n])
        by_gain += wp.cw_mul(by_drawn, drawn[n] - (1.0 - alpha[n]) * behind)
        by_offset += alpha[n] * slopes[n]
        slopes[n] = by_drawn
        n += lanes
    sums[lane, 0] = by_gain
    sums[lane, 1] = by_offset


@wp.kernel
def join_sums(first: int, sums: wp.array2d(dtype=wp.vec3), joined: wp.array2d(dtype=wp.vec3)):
    """joined: (rows, 2) sums of every `rows`th row of `sums`, one item per row."""
    row = first + wp.tid()
    by_gain = wp.vec3()
    by_offset = wp.vec3()
    n = row
    while n < sums.shape[0]:
        by_gain += sums[n, 0]
        by_offset += sums[n, 1]
        n += joined.shape[0]
    joined[row, 0] = by_gain
    joined[row, 1] = by_offset


@wp.kernel
def shrink_pictures(first: int, side: int, fine: Pictures, coarse: wp.array3d(dtype=wp.vec4h)):
    """coarse: (views, h // side, w // side) means of side by side pixels of `fine`. One item per coarse pixel."""
    view, row, column = grid_place(first + wp.tid(), coarse.shape[1], coarse.shape[2])
    total = wp.vec4()
    for i in range(side):
        for j in range(side):
            total += picture_pixel(fine, view, side * row + i, side * column + j)
    total = total / float(side * side)
    coarse[view, row, column] = wp.vec4h(
        wp.float16(total[0]), wp.float16(total[1]), wp.float16(total[2]), wp.float16(total[3])
    )


@wp.kernel
def shrink_weights(first: int, side: int, fine: wp.array3d(dtype=wp.uint8), coarse: wp.array3d(dtype=wp.uint8)):
    """coarse: (views, h // side, w // side) least of side by side weights of `fine`. One item per coarse pixel."""
    view, row, column = grid_place(first + wp.tid(), coarse.shape[1], coarse.shape[2])
    least = int(255)
    for i in range(side):
        for j in range(side):
            least = wp.min(least, int(fine[view, side * row + i, side * column + j]))
    coarse[view, row, column] = wp.uint8(least)


@wp.func
def adam_change(step: SplatStep, rate: float, slope: float, mean: float, square: float):
    """How far a value goes, and the means of its slopes and of their squares after it."""
    m = step.beta1 * mean + (1.0 - step.beta1) * slope
    v = step.beta2 * square + (1.0 - step.beta2) * slope * slope
    return rate * step.mean_factor * m / (step.root_factor * wp.sqrt(v) + step.epsilon), m, v


@wp.kernel
def step_exposure(
    first: int,
    step: wp.array(dtype=SplatStep),
    missed: wp.array(dtype=wp.int32),
    sums: wp.array2d(dtype=wp.vec3),
    exposures: Exposures,
):
    """One item. Step the gains and the offsets of the step's picture by the sums (rows, 2) of their slopes."""
    if first + wp.tid() > 0 or missed[0] == 1 or step[0].rate_exposure == 0.0:
        return
    now = step[0]
    done = exposures.steps[now.view] + 1  # what other pictures learn does not move this one
    share1 = 1.0 - wp.pow(now.beta1, float(done))
    share2 = 1.0 - wp.pow(now.beta2, float(done))
    for kind in range(2):
        slope = wp.vec3()
        for row in range(sums.shape[0]):
            slope += sums[row, kind]
        m = now.beta1 * exposures.means[now.view, kind] + (1.0 - now.beta1) * slope
        v = now.beta2 * exposures.squares[now.view, kind] + (1.0 - now.beta2) * wp.cw_mul(slope, slope)
        value = exposures.values[now.view, kind]
        for i in range(3):
            value[i] = value[i] - now.rate_exposure * (m[i] / share1) / (wp.sqrt(v[i] / share2) + now.epsilon)
        exposures.values[now.view, kind] = value
        exposures.means[now.view, kind] = m
        exposures.squares[now.view, kind] = v
    exposures.steps[now.view] = done


@wp.kernel
def center_exposures(first: int, exposures: Exposures):
    """Take the mean over all pictures from the gains and the offsets, which the splats' own colors are. Two items."""
    kind = first + wp.tid()
    views = exposures.values.shape[0]
    mean = wp.vec3()
    for view in range(views):
        mean += exposures.values[view, kind]
    mean = mean / float(views)
    for view in range(views):
        exposures.values[view, kind] = exposures.values[view, kind] - mean


@wp.func
def elongation_slopes(step: SplatStep, logs: wp.vec3):
    """Slopes by the logarithms of scales of the loss of what is longer than it may be."""
    found = wp.vec3()
    if step.most_elongation > 0.0:
        longest = int(wp.argmax(logs))
        shortest = int(wp.argmin(logs))
        middle = wp.where(longest == shortest, (longest + 1) % 3, 3 - longest - shortest)
        ratio = wp.exp(logs[longest] - logs[middle])
        if ratio > step.most_elongation:
            found[longest] = step.elongation_weight * ratio
            found[middle] = -step.elongation_weight * ratio
    return found


@wp.kernel
def find_floors(
    first: int,
    pixels: float,
    lenses: wp.array(dtype=Lens),
    centers: wp.array(dtype=wp.vec3),
    floors: wp.array(dtype=wp.float32),
):
    """floors: (n,) logarithm of the size of so many pixels of the nearest lens that has a splat in its picture."""
    # Yu et al., "Mip-Splatting" (2024), Eq. 7 and 9: a splat smaller than half a pixel of all pictures is noise
    n = first + wp.tid()
    center = centers[n]
    least = float(wp.inf)
    for view in range(lenses.shape[0]):
        camera = lenses[view].camera
        place = wp.transpose(camera.rotation) * (center - camera.center)
        z = place[2]
        if z >= lenses[view].near:
            # in the picture, or 15 % of it beside
            x = (camera.focal[0] * place[0] / z + camera.principal_point[0]) / float(camera.width)
            y = (camera.focal[1] * place[1] / z + camera.principal_point[1]) / float(camera.height)
            if wp.abs(x - 0.5) <= 0.65 and wp.abs(y - 0.5) <= 0.65:
                least = wp.min(least, z / wp.max(camera.focal[0], camera.focal[1]))
    floors[n] = wp.where(least < wp.inf, wp.log(pixels * least), -wp.inf)


@wp.func
def wander(step: SplatStep, n: int, opacity: float, covariance: wp.mat33):
    """Random shift of the centre of splat n, zero unless it is almost transparent."""
    moved = wp.vec3()
    if step.noise > 0.0 and opacity < STILL_OPACITY:
        state = wp.rand_init(step.seed, n)
        share = step.noise / (1.0 + wp.exp(SHARPNESS * (opacity - DEAD_OPACITY)))
        moved = share * (covariance * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state)))
    return moved


@wp.kernel
def step_splats(
    first: int,
    splats: Splats,
    lens: wp.array(dtype=Lens),
    step: wp.array(dtype=SplatStep),
    missed: wp.array(dtype=wp.int32),
    floors: wp.array(dtype=wp.float32),
    view: wp.array(dtype=wp.vec4),
    sums: wp.array(dtype=wp.float32),
    values: SplatValues,
    means: SplatValues,
    squares: SplatValues,
    colors: wp.array(dtype=wp.vec3),
    weights: wp.array2d(dtype=wp.float32),
):
    """Step all values but the harmonics, and make the splats of them. colors: (n,) slopes by the colors; weights:
    (n, bases) slopes of those by the harmonics, 0 for what is not seen. missed: 1 where nothing may move."""
    # floors: (n,) least logarithms of scales, or empty
    n = first + wp.tid()
    now = step[0]
    logs = values.log_scales[n]
    quaternion = values.quaternions[n]
    found = row_slopes(splats, n, lens[0], logs, quaternion, view, sums)
    is_seen = wp.length_sq(found.direction) > 0.0
    colors[n] = found.color
    basis = sh_basis(found.direction)
    for b in range(16):
        if b < weights.shape[1]:
            weights[n, b] = wp.where(is_seen, basis[b], 0.0)
    if missed[0] == 1:
        return
    opacity = splats.opacities[n]
    center = values.centers[n]
    if is_seen or now.every == 1:
        mean = means.centers[n]
        square = squares.centers[n]
        for i in range(3):
            change, m, v = adam_change(now, now.rate_centers, found.center[i], mean[i], square[i])
            center[i] = center[i] - change
            mean[i] = m
            square[i] = v
        means.centers[n] = mean
        squares.centers[n] = square

        scale_mean = means.log_scales[n]
        scale_square = squares.log_scales[n]
        beyond = elongation_slopes(now, logs)
        for i in range(3):
            slope = found.log_scales[i] + now.scale_weight * wp.exp(logs[i]) + beyond[i]
            change, m, v = adam_change(now, now.rate_log_scales, slope, scale_mean[i], scale_square[i])
            logs[i] = wp.min(logs[i] - change, now.most_log_scale)
            scale_mean[i] = m
            scale_square[i] = v
        if floors.shape[0] > 0:
            logs = wp.max(logs, wp.vec3(floors[n], floors[n], floors[n]))
        means.log_scales[n] = scale_mean
        squares.log_scales[n] = scale_square

        turn_mean = means.quaternions[n]
        turn_square = squares.quaternions[n]
        for i in range(4):
            change, m, v = adam_change(now, now.rate_quaternions, found.quaternion[i], turn_mean[i], turn_square[i])
            quaternion[i] = quaternion[i] - change
            turn_mean[i] = m
            turn_square[i] = v
        means.quaternions[n] = turn_mean
        squares.quaternions[n] = turn_square

        slope = found.logit + now.opacity_weight * opacity * (1.0 - opacity)
        change, m, v = adam_change(now, now.rate_logits, slope, means.logits[n], squares.logits[n])
        logit = values.logits[n] - change
        means.logits[n] = m
        squares.logits[n] = v
        values.log_scales[n] = logs
        values.quaternions[n] = quaternion
        values.logits[n] = logit
        write_splat(splats, n, logs, quaternion, logit)
    values.centers[n] = center + wander(now, n, splats.opacities[n], covariance_of(splats.covariances, n))


@wp.kernel
def step_harmonics(
    first: int,
    bases: int,
    together: int,
    step: wp.array(dtype=SplatStep),
    missed: wp.array(dtype=wp.int32),
    colors: wp.array(dtype=wp.vec3),
    weights: wp.array2d(dtype=wp.float32),
    values: wp.array2d(dtype=wp.float32),
    means: wp.array2d(dtype=wp.float32),
    squares: wp.array2d(dtype=wp.float32),
):
    """Step the harmonics (n, 3 * all bases). One item per splat and `together` of the `bases` that are used yet: one
    on CUDA, all on a CPU."""
    item = first + wp.tid()
    parts = bases // together
    n = item // parts
    begin = (item % parts) * together
    is_seen = weights[n, 0] > 0.0
    if missed[0] == 1 or not (is_seen or step[0].every == 1):
        return
    now = step[0]
    color = colors[n]
    for b in range(begin, begin + together):
        weight = weights[n, b]
        rate = wp.where(b == 0, now.rate_colors, now.rate_harmonics)
        for channel in range(3):
            at = 3 * b + channel
            change, m, v = adam_change(now, rate, weight * color[channel], means[n, at], squares[n, at])
            values[n, at] = values[n, at] - change
            means[n, at] = m
            squares[n, at] = v
