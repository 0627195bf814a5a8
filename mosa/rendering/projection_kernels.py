"""Warp kernels that project 3D Gaussians into images and carry gradients back, one thread per Gaussian (and image).

Local affine approximation of the perspective map (EWA splatting, Zwicker et al. 2001; 3D Gaussian Splatting, Kerbl
et al. 2023): Sigma_2D = J R Sigma R^T J^T + 0.3 I. The conventions are those of `rasterizer`; the adjoint is
written by hand.
"""

import functools

import warp as wp

from mosa.rendering.records import gradient_functions, record_functions, record_type

TILE = 16
"""Side of a tile [px]."""

LOW_PASS = 0.3
"""Added to the diagonal of every projected covariance [px^2]."""

ALPHA_MIN = 1.0 / 255.0
"""Contributions below are skipped."""


@functools.cache
def projection_kernels(dtype: type):
    """(project, project_backward) for one Warp scalar type.

    Arrays are flat: `means`, `covariances` over S * N, records and their moments (records.py) over B * N. `settings` holds
    near plane, clamp margin (0.3) and largest extent in standard deviations."""
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec3 = wp.types.vector(length=3, dtype=dtype)
    vec4 = wp.types.vector(length=4, dtype=dtype)
    mat22 = wp.types.matrix(shape=(2, 2), dtype=dtype)
    mat23 = wp.types.matrix(shape=(2, 3), dtype=dtype)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=dtype)
    mat44 = wp.types.matrix(shape=(4, 4), dtype=dtype)
    record = record_type(dtype)
    load, store, pack, _, conic, _ = record_functions(dtype)
    center_gradient, conic_gradient, opacity_gradient = gradient_functions(dtype)

    @wp.func
    def rotation(w2c: mat44):
        return mat33(
            w2c[0, 0], w2c[0, 1], w2c[0, 2], w2c[1, 0], w2c[1, 1], w2c[1, 2], w2c[2, 0], w2c[2, 1], w2c[2, 2]
        )  # fmt: skip

    @wp.func
    def to_camera(w2c: mat44, m: vec3):
        return rotation(w2c) * m + vec3(w2c[0, 3], w2c[1, 3], w2c[2, 3])

    @wp.func
    def slope_limits(K: mat33, width: int, height: int, margin: dtype):
        """Smallest and largest x/z, then y/z, at which J is evaluated: the image plus `margin` half fields of
        view."""
        w = dtype(width)
        h = dtype(height)
        half_x = dtype(0.5) * w / K[0, 0]
        half_y = dtype(0.5) * h / K[1, 1]
        return vec4(
            -K[0, 2] / K[0, 0] - margin * half_x,
            (w - K[0, 2]) / K[0, 0] + margin * half_x,
            -K[1, 2] / K[1, 1] - margin * half_y,
            (h - K[1, 2]) / K[1, 1] + margin * half_y,
        )

    @wp.func
    def jacobian(K: mat33, p: vec3, limits: vec4):
        z = p[2]
        tx = z * wp.clamp(p[0] / z, limits[0], limits[1])
        ty = z * wp.clamp(p[1] / z, limits[2], limits[3])
        across = -(K[0, 0] * tx + K[0, 1] * ty) / (z * z)
        down = -K[1, 1] * ty / (z * z)
        return mat23(K[0, 0] / z, K[0, 1] / z, across, dtype(0.0), K[1, 1] / z, down)

    @wp.func
    def symmetric(A: mat33):
        return dtype(0.5) * (A + wp.transpose(A))

    @wp.func
    def covariance_gradient(c: vec3, g: vec3):
        """dL/dSigma_2D = -P (dL/dP) P of a conic P = (xx, xy, yy), whose off-diagonal entry stands for two."""
        half = dtype(0.5)
        P = mat22(c[0], c[1], c[1], c[2])
        return -P * mat22(g[0], half * g[1], half * g[1], g[2]) * P

    @wp.func
    def point_gradient(K: mat33, p: vec3, limits: vec4, gc: vec2, gJ: mat23):
        """dL/dp of a point in camera axes, from those of its pixel and of J there."""
        two = dtype(2.0)
        fx = K[0, 0]
        sk = K[0, 1]
        fy = K[1, 1]
        z = p[2]
        z2 = z * z
        sx = wp.clamp(p[0] / z, limits[0], limits[1])
        sy = wp.clamp(p[1] / z, limits[2], limits[3])
        gx = fx / z * gc[0]
        gy = sk / z * gc[0] + fy / z * gc[1]
        gz = -(fx * p[0] + sk * p[1]) / z2 * gc[0] - fy * p[1] / z2 * gc[1]
        gz -= fx / z2 * gJ[0, 0] + sk / z2 * gJ[0, 1] + fy / z2 * gJ[1, 1]
        gz += two * (fx * sx + sk * sy) / z2 * gJ[0, 2] + two * fy * sy / z2 * gJ[1, 2]
        gtx = -fx / z2 * gJ[0, 2]
        gty = -sk / z2 * gJ[0, 2] - fy / z2 * gJ[1, 2]
        if p[0] / z == sx:
            gx += gtx
        else:
            gz += sx * gtx
        if p[1] / z == sy:
            gy += gty
        else:
            gz += sy * gty
        return vec3(gx, gy, gz)

    @wp.kernel(enable_backward=False, module="unique")
    def project(
        means: wp.array(dtype=vec3), covariances: wp.array(dtype=mat33),
        opacities: wp.array(dtype=dtype), opacity_stride: int, K: wp.array(dtype=mat33),
        w2c: wp.array(dtype=mat44), state_index: wp.array(dtype=wp.int32), settings: vec3,
        count: int, width: int, height: int,
        # out
        records: wp.array(dtype=record), depths: wp.array(dtype=dtype),
    ):  # fmt: skip
        b, n = wp.tid()
        i = b * count + n
        s = state_index[b] * count + n
        p = to_camera(w2c[b], means[s])
        o = opacities[state_index[b] * opacity_stride + n]
        depth = dtype(wp.inf)
        result = record()
        if p[2] > settings[0] and o >= dtype(ALPHA_MIN):
            limits = slope_limits(K[b], width, height, settings[1])
            T = jacobian(K[b], p, limits) * rotation(w2c[b])
            S = T * symmetric(covariances[s]) * wp.transpose(T)
            sxx = S[0, 0] + dtype(LOW_PASS)
            syy = S[1, 1] + dtype(LOW_PASS)
            sxy = S[0, 1]
            det = sxx * syy - sxy * sxy
            if det > dtype(0.0):
                u = (K[b][0, 0] * p[0] + K[b][0, 1] * p[1]) / p[2] + K[b][0, 2]
                v = K[b][1, 1] * p[1] / p[2] + K[b][1, 2]
                depth = p[2]
                w = dtype(width)
                h = dtype(height)
                zero = dtype(0.0)
                e = wp.min(settings[2], wp.sqrt(dtype(2.0) * wp.log(dtype(255.0) * o)))
                rx = wp.ceil(e * wp.sqrt(sxx))
                ry = wp.ceil(e * wp.sqrt(syy))
                x0 = wp.clamp(wp.floor(u - rx), zero, w)
                x1 = wp.clamp(wp.ceil(u + rx), zero, w)
                y0 = wp.clamp(wp.floor(v - ry), zero, h)
                y1 = wp.clamp(wp.ceil(v + ry), zero, h)
                rect = wp.vec4i(int(x0), int(x1), int(y0), int(y1))
                result = pack(vec2(u, v), o, vec3(syy / det, -sxy / det, sxx / det), rect)
        store(records, i, result)
        depths[i] = depth

    @wp.kernel(enable_backward=False, module="unique")
    def project_backward(
        means: wp.array(dtype=vec3), covariances: wp.array(dtype=mat33), opacity_stride: int,
        K: wp.array(dtype=mat33), w2c: wp.array(dtype=mat44), state_index: wp.array(dtype=wp.int32),
        settings: vec3, count: int, width: int, height: int, images: int,
        records: wp.array(dtype=record), moments: wp.array(dtype=record),
        # out, zero at first
        grad_means: wp.array(dtype=vec3), grad_covariances: wp.array(dtype=mat33),
        grad_opacities: wp.array(dtype=dtype),
    ):  # fmt: skip
        # one thread per Gaussian goes through all images: sums over images without atomics, the same at every run
        n = wp.tid()
        gm = vec3()
        gA = mat33()
        go = dtype(0.0)
        for b in range(images):
            i = b * count + n
            m = load(moments, i)
            if wp.max(wp.abs(m)) > dtype(0.0):
                r = load(records, i)
                R = rotation(w2c[b])
                p = to_camera(w2c[b], means[state_index[b] * count + n])
                limits = slope_limits(K[b], width, height, settings[1])
                T = jacobian(K[b], p, limits) * R
                G = covariance_gradient(conic(r), conic_gradient(m))
                S = symmetric(covariances[state_index[b] * count + n])
                gJ = dtype(2.0) * G * T * S * wp.transpose(R)
                gA += wp.transpose(T) * G * T
                gm += wp.transpose(R) * point_gradient(K[b], p, limits, center_gradient(r, m), gJ)
                go += opacity_gradient(r, m)
            # images of one state mostly follow each other: one write for all of them
            if b == images - 1 or state_index[wp.min(b + 1, images - 1)] != state_index[b]:
                s = state_index[b] * count + n
                k = state_index[b] * opacity_stride + n
                grad_covariances[s] = grad_covariances[s] + gA
                grad_means[s] = grad_means[s] + gm
                grad_opacities[k] = grad_opacities[k] + go
                gA = mat33()
                gm = vec3()
                go = dtype(0.0)

    return project, project_backward
