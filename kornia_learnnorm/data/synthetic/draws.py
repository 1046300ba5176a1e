r"""Random draws for synthetic scenes: cameras, points, depths and motions, in float64 on the generator's device."""

import math

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, convert_points_to_homogeneous
from torch import Generator, Tensor
from torch.nn.functional import normalize

MOTION_CANDIDATES = 4  # per scene
GROUND_SHARE = 0.9  # of the points whose ray meets the ground plane


def uniform(shape: tuple[int, ...], low: float, high: float, generator: Generator) -> Tensor:
    """Draw uniform numbers between ``low`` and ``high``."""
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64, device=generator.device)


def log_uniform(shape: tuple[int, ...], low: float, high: float | Tensor, generator: Generator) -> Tensor:
    """Draw numbers between ``low`` and ``high`` whose logarithm is uniform."""
    return low * (high / low) ** uniform(shape, 0.0, 1.0, generator)


def normal(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw numbers of the standard normal distribution."""
    return torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)


def student_t(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw isotropic vectors ``(*, 2)`` of Student's t, 3 degrees of freedom (R. Bailey's polar method, 1994)."""
    u = 1 - uniform(shape[:-1], 0.0, 1.0, generator)  # in (0, 1]
    radius = (3 * (u ** (-2 / 3) - 1)).sqrt()
    angle = uniform(shape[:-1], 0.0, 2 * math.pi, generator)
    return radius[..., None] * torch.stack([angle.cos(), angle.sin()], -1)


def fixed_camera(
    batch_size: int, size: tuple[float, float], focal: float, centre: tuple[float, float], generator: Generator
) -> tuple[Tensor, Tensor]:
    """Return image sizes ``(B, 2)``, pixels, and intrinsics ``(B, 3, 3)`` of one camera, repeated."""
    like = torch.empty(0, dtype=torch.float64, device=generator.device)
    K = _camera(like.new_full((batch_size, 1), focal), like.new_tensor(centre))
    return like.new_tensor(size).repeat(batch_size, 1), K


def random_cameras(batch_size: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw image sizes ``(B, 2)``, pixels, and intrinsics ``(B, 3, 3)``."""
    width = uniform((batch_size, 1), 400.0, 1400.0, generator)
    size = torch.cat([width, width * uniform((batch_size, 1), 0.3, 0.8, generator)], -1).round()
    centre = (size - 1) / 2 + size * uniform((batch_size, 2), -0.03, 0.03, generator)
    return size, _camera(width * uniform((batch_size, 1), 0.5, 1.3, generator), centre)


def _camera(focal: Tensor, centre: Tensor) -> Tensor:
    """Return intrinsics ``(B, 3, 3)`` of focal lengths ``(B, 1)`` and principal points ``(B, 2)``."""
    K = torch.eye(3).to(focal).repeat(focal.shape[0], 1, 1)
    K[:, :2, :2] *= focal[..., None]
    K[:, :2, 2] = centre
    return K


def spread_points(size: Tensor, num_points: int, generator: Generator, clustered: float = 0.0) -> Tensor:
    """Draw pixels ``(B, N, 2)`` in the image, uniform or, in a share of the scenes, around one to four centres."""
    batch_size, last = size.shape[0], size[:, None] - 1
    anywhere = last * uniform((batch_size, num_points, 2), 0.0, 1.0, generator)
    if clustered == 0:
        return anywhere
    chosen = uniform((batch_size, 1, 1), 0.0, 1.0, generator) < clustered
    # The first uniform points are the centres; a clustered point outside of the image is replaced by a uniform one.
    count = 1 + torch.floor(uniform((batch_size, 1), 0.0, 4.0, generator))
    index = torch.floor(count * uniform((batch_size, num_points), 0.0, 1.0, generator)).long()
    centres = anywhere.gather(1, index[..., None].expand(-1, -1, 2))
    spread = last[..., :1] * log_uniform((batch_size, 1, 1), 0.03, 0.15, generator)
    around = centres + spread * normal((batch_size, num_points, 2), generator)
    inside = ((around >= 0) & (around <= last)).all(-1, keepdim=True)
    return torch.where(chosen & inside, around, anywhere)


def draw_depths(
    points1: Tensor, K: Tensor, near: float, far: float, height: Tensor, generator: Generator, tilt: float = 0.0
) -> Tensor:
    """Draw depths ``(B, N)``: log-uniform, or of most rays that meet it, those of a ground ``height`` below."""
    batch_size, num_points = points1.shape[:2]
    free = log_uniform((batch_size, num_points), near, far, generator)
    slopes = tilt * normal((batch_size, 2), generator)
    ground_normal = torch.stack([slopes[:, 0], torch.ones_like(slopes[:, 0]), slopes[:, 1]], -1)
    ground = height / (viewing_rays(points1, K) @ ground_normal[..., None]).squeeze(-1)
    grounded = uniform((batch_size, num_points), 0.0, 1.0, generator) < GROUND_SHARE
    return torch.where(grounded & (ground > near) & (ground < far), ground, free)


def viewing_rays(points1: Tensor, K: Tensor) -> Tensor:
    """Return the viewing rays ``(B, N, 3)`` of pixels ``(B, N, 2)``, of depth one."""
    focal, centre = K[:, None].diagonal(dim1=-2, dim2=-1)[..., :2], K[:, None, :2, 2]
    return convert_points_to_homogeneous((points1 - centre) / focal)


def motions(axes: Tensor, angle: Tensor, direction: Tensor, baseline: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``R (B, C, 3, 3), t (B, C, 3)`` for axes and directions ``(B, C, 3)`` of any length; ``t = -R centre``."""
    R = axis_angle_to_rotation_matrix(angle[..., None] * normalize(axes, dim=-1))
    centre = baseline[..., None] * normalize(direction, dim=-1)
    return R, -(R @ centre[..., None]).squeeze(-1)


def random_motions(median_depth: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw candidate motions ``R (B, C, 3, 3), t (B, C, 3)``: in a third of the scenes forward, else anywhere."""
    shape = (median_depth.shape[0], MOTION_CANDIDATES)
    driving = uniform((shape[0], 1), 0.0, 1.0, generator) < 1 / 3
    doubled = (uniform((shape[0], 1), 0.0, 1.0, generator) < 1 / 3) & ~driving
    angle = log_uniform(shape, 0.002, torch.where(driving, 0.06, 0.24).double(), generator)
    baseline = median_depth * log_uniform(shape, 0.01, 0.4, generator)
    direction, axes = (normal((*shape, 3), generator) for _ in range(2))
    forward, upright = direction.new_tensor([0.1, 0.05, 0.05]), direction.new_tensor([0.3, 1.0, 0.3])
    ahead = direction * forward + direction.new_tensor([0.0, 0.0, 1.0])
    direction = torch.where(driving[..., None], ahead, direction)
    axes = torch.where(driving[..., None], axes * upright, axes)
    return motions(axes, torch.where(doubled, 2 * angle, angle), direction, baseline)
