#version 330 core
// The Warp ray caster does the same computation, with the same names, in ray_caster.py.

// pyrender's own defines decide which parts are compiled: HAS_BASE_COLOR_TEX with TEXCOORD_0_LOC is an image with
// texture coordinates, alone an equirectangular image with points of the sphere; TEXCOORD_1_LOC draws edges. Nothing is
// of metal: the metallic factor says whether an image has levels.
struct Material { vec4 base_color_factor; float metallic_factor, roughness_factor; sampler2D base_color_texture; };

uniform Material material;
uniform mat4 P;
layout(std140) uniform Look {
    mat4 lights;  // a column each: where it is, of unit length, seen from the camera, and its power
    vec4 edge;  // colour and opacity
    float edge_width, sky, ground;
    int light_count;
};

in vec3 seen_position, seen_normal, carried, weights;

out vec4 frag_color;

const float PI = 3.14159265358979, MOST_PROBES = 48.0;

vec3 to_linear(vec3 c) {
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(vec3(0.04045), c));
}

vec3 to_srgb(vec3 c) {
    c = clamp(c, 0.0, 1.0);
    return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(vec3(0.0031308), c));
}

#ifdef HAS_BASE_COLOR_TEX
// The mean of the image over the pixel: its footprint is the ellipse that the derivatives span; probes along the long
// axis, each from the mip level of the short one. The hardware's own anisotropic filter takes the two derivatives
// for the axes, which blurs the poles along the diagonals, where the derivatives are long, alike and nearly parallel.
vec3 filtered(vec2 uv, vec2 along_x, vec2 along_y) {
    vec2 size = vec2(textureSize(material.base_color_texture, 0));
    mat2 span = mat2(along_x * size, along_y * size);
    mat2 square = span * transpose(span);
    vec2 gap = vec2(0.5 * (square[0][0] - square[1][1]), square[0][1]);
    float longest = sqrt(0.5 * (square[0][0] + square[1][1]) + length(gap));
    float shortest = abs(determinant(span)) / max(longest, 1e-12);
    float turn = 0.5 * atan(gap.y, gap.x + 1e-30);
    float probes = clamp(ceil(longest / max(shortest, 1.0)), 1.0, mix(1.0, MOST_PROBES, material.metallic_factor));
    float level = log2(max(max(shortest, longest / probes), 1.0));
    vec2 stride = vec2(cos(turn), sin(turn)) * longest / (size * probes);
    vec3 sum = vec3(0.0);
    for (float k = 0.5 - 0.5 * probes; k < 0.5 * probes; k += 1.0)
        sum += textureLod(material.base_color_texture, uv + k * stride, level).rgb;
    return sum / probes;
}

#ifndef TEXCOORD_0_LOC
// Change of longitude and latitude with a point of the sphere, by the chain rule: no branch cut, hence no seam.
vec2 turned(vec3 p, vec3 change, float rho) {
    float east = (p.x * change.y - p.y * change.x) / (rho * rho);
    float north = (rho * change.z - p.z * dot(p.xy, change.xy) / rho) / (rho * rho + p.z * p.z);
    return vec2(east / (2.0 * PI), north / PI);
}
#endif
#endif

vec3 surface_color() {
    vec3 p = carried;
#ifdef HAS_BASE_COLOR_TEX
    vec3 px = dFdx(p), py = dFdy(p);
#ifdef TEXCOORD_0_LOC
    vec3 mean = filtered(p.xy, px.xy, py.xy);
#else
    // Within a quarter of a pixel of a pole the footprint is the whole parallel; the bound keeps it finite.
    float rho = sqrt(max(dot(p.xy, p.xy), max(0.0625 * max(dot(px, px), dot(py, py)), 1e-20)));
    float angle = dot(p.xy, p.xy) > 0.0 ? atan(p.y, p.x) : 0.0;
    vec2 uv = vec2(0.5 + angle / (2.0 * PI), 0.5 + atan(p.z, length(p.xy)) / PI);
    vec3 mean = filtered(uv, turned(p, px, rho), turned(p, py, rho));
#endif
    return mean * to_linear(material.base_color_factor.rgb);
#else
    return to_linear(p);
#endif
}

// Lambert's diffuse term and a GGX highlight with Schlick's Fresnel and Smith's shadowing, as glTF 2.0, appendix B.
// With h = (l + v) / |l + v| and |l + v|² = 2 (1 + l.v) all angles come from n.l, n.v and l.v.
vec3 lit(vec3 albedo, vec3 n, vec3 v) {
    float alpha2 = pow(material.roughness_factor, 4.0);
    float k = pow(material.roughness_factor + 1.0, 2.0) / 8.0;
    float facing = dot(n, v);
    float shadow = min(max(abs(facing), 0.001), 1.0) * (1.0 - k) + k;
    vec2 sum = vec2(0.0);  // diffuse, shine
    for (int i = 0; i < light_count; ++i) {
        float incident = dot(n, lights[i].xyz);
        float nl = clamp(incident, 0.0, 1.0);
        float both = 1.0 + dot(v, lights[i].xyz);
        float scale = inversesqrt(max(2.0 * both, 1e-6));
        float nh = clamp((incident + facing) * scale, 0.0, 1.0);
        float fresnel = 0.04 + 0.96 * pow(1.0 - clamp(both * scale, 0.0, 1.0), 5.0);
        float spread = nh * nh * (alpha2 - 1.0) + 1.0;
        float gloss = alpha2 / (4.0 * PI * spread * spread * (nl * (1.0 - k) + k) * shadow);
        sum += nl * lights[i].w * vec2(1.0 - fresnel, fresnel * gloss);
    }
    return albedo * (mix(ground, sky, 0.5 + 0.5 * n.y) + sum.x / PI) + sum.y;
}

void main() {
    vec3 n = normalize(gl_FrontFacing ? seen_normal : -seen_normal);
    vec3 v = P[3][3] == 1.0 ? vec3(0.0, 0.0, 1.0) : normalize(-seen_position);
    vec3 color = to_srgb(lit(surface_color(), n, v));
#ifdef TEXCOORD_1_LOC
    // Distance to each edge in pixels; lines fade where triangles are only a few pixels high.
    vec3 wx = dFdx(weights), wy = dFdy(weights);
    vec3 height = inversesqrt(max(wx * wx + wy * wy, vec3(1e-20)));
    vec3 line = clamp(0.5 * edge_width + 0.5 - weights * height, 0.0, 1.0);
    line *= clamp((height - edge_width) / (5.0 * edge_width), 0.12, 1.0);
    color = mix(color, edge.rgb, edge.a * max(line.x, max(line.y, line.z)));
#endif
    frag_color = vec4(color, 1.0);
}
