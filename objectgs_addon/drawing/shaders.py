# SPDX-License-Identifier: GPL-3.0-or-later
"""Shaders that draw each splat as a quad with a Gaussian falloff and composite the image over the viewport.

They use GPUShaderCreateInfo, which works with OpenGL, Metal and Vulkan.
"""

import math

import gpu

from ...backend.shared.color import srgb
from ...backend.shared.color.recolor import LUMA
from ...backend.shared.splats import spherical_harmonics as sh
from ...backend.shared.splats.blending import ALPHA_MAX, ALPHA_MIN, MAX_EXTENT

TABLE_WIDTH = 4096
"""Texels per row of data textures."""

SPLAT_TEXELS = 3
"""Texels per splat: mean and opacity, quat, scales."""

OBJECT_TEXELS = 12
"""Texels per object: three rows each of the map to camera space, the map to view directions and the affine map of
colors; the color with its opacity; the marks, 1 where the object is selected and where it is pointed at, and the
variance of the low-pass filter; one unused texel."""

INDEX_OFFSET = 1 << 24
"""Subtracted from the indices of splats in `order`: a float32 holds the integers up to this, also the negative ones."""

MOST_SPLATS = 2 * INDEX_OFFSET

OUTLINE_SAMPLES = 12
"""Number of pixels around one that are searched for an object to outline."""

SELECTED = 0.25
"""Fraction added to the slot of a splat's object in `order` if the splat is selected."""

SELECTED_COLOR = (1.0, 0.85, 0.1)
SELECTED_AMOUNT = 0.6
"""sRGB-encoded color blended over a selected splat's color, and its opacity."""

_CONSTANTS = f"""
#define TABLE_WIDTH {TABLE_WIDTH}
#define SPLAT_TEXELS {SPLAT_TEXELS}
#define OBJECT_TEXELS {OBJECT_TEXELS}
#define INDEX_OFFSET {INDEX_OFFSET}
#define ALPHA_MAX {ALPHA_MAX!r}
#define ALPHA_MIN {ALPHA_MIN!r}
#define MAX_EXTENT {MAX_EXTENT!r}
#define SELECTED_COLOR vec3{SELECTED_COLOR!r}
#define SELECTED_AMOUNT {SELECTED_AMOUNT!r}
#define LUMA vec3({", ".join(repr(float(weight)) for weight in LUMA)})
#define SH_C0 {sh.C0!r}
#define SH_C1 {sh.C1!r}
#define SH_C2 {sh.C2!r}
#define SH_C20 {sh.C20!r}
#define SH_C30 {sh.C30!r}
#define SH_C31 {sh.C31!r}
#define SH_C32 {sh.C32!r}
#define SH_C33 {sh.C33!r}
"""

_SPLAT_VERTEX = (
    _CONSTANTS
    + """
vec4 at(sampler2D table, int index) {
    return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0);
}

vec3 radiance(int splat, vec3 d) {
    int first = splat * bands;
    vec3 c = SH_C0 * at(harmonics, first).rgb;
    if (bands > 1) {
        c += SH_C1 * (d.z * at(harmonics, first + 2).rgb - d.y * at(harmonics, first + 1).rgb
                      - d.x * at(harmonics, first + 3).rgb);
    }
    vec3 s = d * d;
    if (bands > 4) {
        c += SH_C2 * (d.x * d.y * at(harmonics, first + 4).rgb - d.y * d.z * at(harmonics, first + 5).rgb
                      - d.x * d.z * at(harmonics, first + 7).rgb);
        c += SH_C20 * (2.0 * s.z - s.x - s.y) * at(harmonics, first + 6).rgb;
        c += 0.5 * SH_C2 * (s.x - s.y) * at(harmonics, first + 8).rgb;
    }
    if (bands > 9) {
        c -= SH_C33 * d.y * (3.0 * s.x - s.y) * at(harmonics, first + 9).rgb;
        c += SH_C32 * d.x * d.y * d.z * at(harmonics, first + 10).rgb;
        c -= SH_C31 * d.y * (4.0 * s.z - s.x - s.y) * at(harmonics, first + 11).rgb;
        c += SH_C30 * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y) * at(harmonics, first + 12).rgb;
        c -= SH_C31 * d.x * (4.0 * s.z - s.x - s.y) * at(harmonics, first + 13).rgb;
        c += 0.5 * SH_C32 * d.z * (s.x - s.y) * at(harmonics, first + 14).rgb;
        c -= SH_C33 * d.x * (s.x - 3.0 * s.y) * at(harmonics, first + 15).rgb;
    }
    return 0.5 + c;
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    beside = vec2(0.0);
    shape = vec4(0.0);
    tint = vec4(0.0);
    mark = vec2(0.0);
    vec2 entry = at(order, gl_InstanceID).xy;
    int splat = int(entry.x) + INDEX_OFFSET;
    int object = int(entry.y + 0.5) * OBJECT_TEXELS;
    vec4 mean_opacity = at(splats, splat * SPLAT_TEXELS);
    vec4 q = at(splats, splat * SPLAT_TEXELS + 1);
    vec3 scale = at(splats, splat * SPLAT_TEXELS + 2).xyz;
    vec4 to_x = at(objects, object);
    vec4 to_y = at(objects, object + 1);
    vec4 to_z = at(objects, object + 2);
    vec4 mean = vec4(mean_opacity.xyz, 1.0);
    vec3 p = vec3(dot(to_x, mean), dot(to_y, mean), dot(to_z, mean));
    float opacity = mean_opacity.w;
    bool orthographic = size.w > 0.5;
    if (!(p.z > size.z) || !(opacity > ALPHA_MIN)) {
        return;
    }
    vec3 axis_x = scale.x * vec3(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w),
                                 2.0 * (q.y * q.w - q.x * q.z));
    vec3 axis_y = scale.y * vec3(2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w),
                                 2.0 * (q.z * q.w + q.x * q.y));
    vec3 axis_z = scale.z * vec3(2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y),
                                 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
    vec3 along_x = vec3(dot(to_x.xyz, axis_x), dot(to_x.xyz, axis_y), dot(to_x.xyz, axis_z));
    vec3 along_y = vec3(dot(to_y.xyz, axis_x), dot(to_y.xyz, axis_y), dot(to_y.xyz, axis_z));
    vec3 along_z = vec3(dot(to_z.xyz, axis_x), dot(to_z.xyz, axis_y), dot(to_z.xyz, axis_z));
    vec2 slope = vec2(0.0);
    float per_z = 1.0;
    if (!orthographic) {
        per_z = 1.0 / p.z;
        slope = clamp(p.xy * per_z, limits.xz, limits.yw);
    }
    vec3 first = lens.x * per_z * (along_x - slope.x * along_z);
    vec3 second = lens.y * per_z * (along_y - slope.y * along_z);
    float a = dot(first, first);
    float b = dot(first, second);
    float c = dot(second, second);
    vec3 area = cross(first, second);
    vec3 marks_blur = at(objects, object + 10).xyz;
    float blur = marks_blur.z;
    float across2 = (dot(area, area) + blur * (a + c + blur)) / (c + blur);
    a += blur;
    c += blur;
    vec2 extent = sqrt(2.0 * log(opacity / ALPHA_MIN) * vec2(a, c));
    if (!(max(extent.x, extent.y) < MAX_EXTENT)) {
        return;
    }

    vec3 direction = vec3(dot(at(objects, object + 3), mean), dot(at(objects, object + 4), mean),
                          dot(at(objects, object + 5), mean));
    vec4 photo = vec4(radiance(splat, normalize(direction)), 1.0);
    vec3 color = vec3(dot(at(objects, object + 6), photo), dot(at(objects, object + 7), photo),
                       dot(at(objects, object + 8), photo));
    color = max(color, 0.0);
    vec4 own = at(objects, object + 9);
    // Keeps the brightness, so that shapes remain visible.
    float shade = 0.5 + dot(color, LUMA);
    color = mix(color, own.rgb * shade, own.a);
    mark = marks_blur.xy;
    color = mix(color, SELECTED_COLOR, fract(entry.y) > 0.1 ? SELECTED_AMOUNT : 0.0);

    beside = corner * extent;
    shape = vec4(b / c, 0.5 / across2, 0.5 / c, opacity);
    vec2 pixel = lens.xy * p.xy * per_z + lens.zw + beside;
    float depth = (depths.y - depths.x * p.z) * per_z;
    tint = vec4(color, 0.5 * depth + 0.5);
    gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, depth, 1.0);
}
"""
)

_SPLAT_FRAGMENT = (
    _CONSTANTS
    + """
void main() {
    float d = beside.x - shape.x * beside.y;
    float alpha = shape.w * exp(-(shape.y * d * d + shape.z * beside.y * beside.y));
    if (alpha < ALPHA_MIN) {
        discard;
    }
    if (hides > 0 && tint.w > texelFetch(depth, ivec2(gl_FragCoord.xy), 0).r) {
        discard;
    }
    alpha = min(alpha, ALPHA_MAX);
    result = vec4(alpha * tint.rgb, alpha);
    marks = vec4(alpha * mark, 0.0, alpha);
}
"""
)

_OVER_VERTEX = """
void main() {
    uv = 0.5 * corner + 0.5;
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""

# The viewport blends linear colors. An object is outlined where its part of a pixel falls below one half.
_OVER_FRAGMENT = f"""
void main() {{
    vec4 drawn = texture(picture, uv);
    vec3 color = drawn.rgb / max(drawn.a, 1e-6);
    vec3 curve = pow((color + {srgb.OFFSET}) / {1.0 + srgb.OFFSET}, vec3({srgb.GAMMA}));
    vec3 line = color / {srgb.LINEAR_SLOPE};
    vec3 on_line = vec3(lessThanEqual(color, vec3({srgb.ENCODED_CUTOFF})));
    result = vec4(mix(curve, line, on_line) * drawn.a, drawn.a);
    vec2 own = texture(marks, uv).rg;
    vec2 most = own;
    for (int turn = 0; turn < {OUTLINE_SAMPLES}; turn++) {{
        float angle = {2.0 * math.pi / OUTLINE_SAMPLES} * float(turn);
        most = max(most, texture(marks, uv + width * vec2(cos(angle), sin(angle))).rg);
    }}
    vec2 outside = smoothstep(vec2(0.3), vec2(0.6), most) * (1.0 - smoothstep(vec2(0.4), vec2(0.6), own));
    result = mix(result, vec4(selected, 1.0), outside.r);
    result = mix(result, vec4(1.0), outside.g);
}}
"""


def splat_shader() -> gpu.types.GPUShader:
    """Create the shader that draws a quad for each entry of `order`.

    Its outputs are premultiplied: the sRGB-encoded picture, and the marks, whose red and green are the parts of a pixel
    that show a selected object and one that is pointed at.
    """
    between = gpu.types.GPUStageInterfaceInfo("objectgs_splat")
    between.smooth("VEC2", "beside")
    between.flat("VEC4", "shape")
    between.flat("VEC4", "tint")
    between.flat("VEC2", "mark")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("VEC4", "lens")
    info.push_constant("VEC4", "size")
    info.push_constant("VEC4", "limits")
    info.push_constant("VEC2", "depths")
    info.push_constant("INT", "bands")
    info.push_constant("INT", "hides")
    for slot, name in enumerate(("order", "splats", "harmonics", "objects", "depth")):
        info.sampler(slot, "FLOAT_2D", name)
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "result")
    info.fragment_out(1, "VEC4", "marks")
    info.vertex_source(_SPLAT_VERTEX)
    info.fragment_source(_SPLAT_FRAGMENT)
    return gpu.shader.create_from_info(info)


def over_shader() -> gpu.types.GPUShader:
    """Create the shader that blends a premultiplied, sRGB-encoded image with outlines over the framebuffer.

    `width` is that of the outlines relative to the image, and `selected` the linear color of the selection's.
    """
    between = gpu.types.GPUStageInterfaceInfo("objectgs_over")
    between.smooth("VEC2", "uv")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("VEC2", "width")
    info.push_constant("VEC3", "selected")
    info.sampler(0, "FLOAT_2D", "picture")
    info.sampler(1, "FLOAT_2D", "marks")
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source(_OVER_VERTEX)
    info.fragment_source(_OVER_FRAGMENT)
    return gpu.shader.create_from_info(info)


def mark_shader() -> gpu.types.GPUShader:
    """Create the shader that marks the pixels of triangles as pointed at."""
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "to_clip")
    info.vertex_in(0, "VEC3", "pos")
    info.fragment_out(0, "VEC4", "result")
    info.fragment_out(1, "VEC4", "marks")
    info.vertex_source("void main() { gl_Position = to_clip * vec4(pos, 1.0); }")
    info.fragment_source("void main() { result = vec4(0.0); marks = vec4(0.0, 1.0, 0.0, 1.0); }")
    return gpu.shader.create_from_info(info)
