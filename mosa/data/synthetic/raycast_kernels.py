"""Ray casting of a triangle mesh with colours at its vertices: an opaque, shaded surface."""

import warp as wp


@wp.kernel(enable_backward=False)
def cast(
    mesh: wp.uint64,
    colors: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    camera_to_world: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    column: int,
    row: int,
    width: int,
    samples: int,
    light: wp.vec3,
    ambient: float,
    image: wp.array2d(dtype=wp.vec4),
):
    """One thread per pixel of a window at (column, row), `samples` squared rays each. image: straight RGB and coverage."""
    i, j = wp.tid()
    color = wp.vec3(0.0, 0.0, 0.0)
    hits = wp.float32(0.0)
    eye = wp.vec3(camera_to_world[0, 3], camera_to_world[1, 3], camera_to_world[2, 3])
    for a in range(samples):
        for b in range(samples):
            u = float(column + j) + (float(b) + 0.5) / float(samples)
            v = float(row + i) + (float(a) + 0.5) / float(samples)
            direction = wp.vec4((u - center[0]) / focal[0], (v - center[1]) / focal[1], 1.0, 0.0)
            seen = camera_to_world * direction
            ray = wp.normalize(wp.vec3(seen[0], seen[1], seen[2]))
            query = wp.mesh_query_ray(mesh, eye, ray, 1.0e3)
            if query.result:
                p = wp.mesh_get_index(mesh, query.face * 3)
                q = wp.mesh_get_index(mesh, query.face * 3 + 1)
                r = wp.mesh_get_index(mesh, query.face * 3 + 2)
                w = 1.0 - query.u - query.v
                albedo = query.u * colors[p] + query.v * colors[q] + w * colors[r]
                normal = wp.normalize(query.u * normals[p] + query.v * normals[q] + w * normals[r])
                # half Lambert: light wraps round the body, so that no side is flat and dark
                wrapped = 0.5 + 0.5 * wp.dot(normal, light)
                color += albedo * (ambient + (1.0 - ambient) * wrapped * wrapped)
                hits += 1.0
    if hits > 0.0:
        color = color / hits
    image[i, j] = wp.vec4(color[0], color[1], color[2], hits / float(samples * samples))
