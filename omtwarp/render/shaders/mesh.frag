#version 330 core
// The Warp ray caster does the same computation, with the same names, in ray_caster.py.

// pyrender's own defines decide which parts are compiled: HAS_BASE_COLOR_TEX with TEXCOORD_0_LOC is an image with
// texture coordinates, alone an equirectangular image with points of the sphere; TEXCOORD_1_LOC draws edges.
// Its uniforms are taken so: the base colour is a factor on an image, and its alpha the opacity of edges; the emissive
// factor is the colour of edges; the metallic factor says whether an image has levels; the ambient light is that from
// above, that from below, and the width of edges; lights are where they are seen from the camera, infinitely far away.
uniform struct {
    vec4 base_color_factor;
    vec3 emissive_factor;
    float metallic_factor, roughness_factor;
    sampler2D base_color_texture;
} material;
uniform struct { vec3 position; float intensity; } point_lights[4];
uniform vec3 ambient_light;
uniform mat4 P;
uniform int n_point_lights;

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
    float level = material.metallic_factor * log2(max(max(shortest, longest / probes), 1.0));
    vec2 stride = vec2(cos(turn), sin(turn)) * longest / (size * probes);
    vec3 sum = vec3(0.0);
    for (float k = 0.5 - 0.5 * probes; k < 0.5 * probes; k += 1.0)
        sum += textureLod(material.base_color_texture, uv + k * stride, level).rgb;
    return sum / probes * to_linear(material.base_color_factor.rgb);
}

vec3 surface_color() {
    vec3 p = carried, px = dFdx(p), py = dFdy(p);
#ifndef HAS_BASE_COLOR_TEX
    return to_linear(p);
#endif
#ifdef TEXCOORD_0_LOC
    return filtered(p.xy, px.xy, py.xy);
#endif
    // Within a quarter of a pixel of a pole the footprint is the whole parallel; the bound keeps it finite.
    float rho = sqrt(max(dot(p.xy, p.xy), max(0.0625 * max(dot(px, px), dot(py, py)), 1e-20)));
    float angle = dot(p.xy, p.xy) > 0.0 ? atan(p.y, p.x) : 0.0;
    vec2 uv = vec2(0.5 + angle / (2.0 * PI), 0.5 + atan(p.z, length(p.xy)) / PI);
    // Gradients of longitude and latitude, by the chain rule: no branch cut, hence no seam.
    vec3 east = vec3(-p.y, p.x, 0.0) / (2.0 * PI * rho * rho);
    vec3 north = vec3(-p.xy * p.z / rho, rho) / (PI * (rho * rho + p.z * p.z));
    return filtered(uv, vec2(dot(east, px), dot(north, px)), vec2(dot(east, py), dot(north, py)));
}

// Lambert's diffuse term and a GGX highlight with Schlick's Fresnel and Smith's shadowing, as glTF 2.0, appendix B.
// With h = (l + v) / |l + v| and |l + v|² = 2 (1 + l.v) all angles come from n.l, n.v and l.v.
vec3 lit(vec3 albedo, vec3 n, vec3 v) {
    float alpha2 = pow(material.roughness_factor, 4.0);
    float k = pow(material.roughness_factor + 1.0, 2.0) / 8.0;
    float facing = dot(n, v);
    float shadow = min(max(abs(facing), 0.001), 1.0) * (1.0 - k) + k;
    vec2 sum = vec2(0.0);  // diffuse, shine
    for (int i = 0; i < n_point_lights; ++i) {
        float incident = dot(n, point_lights[i].position);
        float nl = clamp(incident, 0.0, 1.0);
        float both = 1.0 + dot(v, point_lights[i].position);
        float scale = inversesqrt(max(2.0 * both, 1e-6));
        float nh = clamp((incident + facing) * scale, 0.0, 1.0);
        float fresnel = 0.04 + 0.96 * pow(1.0 - clamp(both * scale, 0.0, 1.0), 5.0);
        float spread = nh * nh * (alpha2 - 1.0) + 1.0;
        float gloss = alpha2 / (4.0 * PI * spread * spread * (nl * (1.0 - k) + k) * shadow);
        sum += nl * point_lights[i].intensity * vec2(1.0 - fresnel, fresnel * gloss);
    }
    return albedo * (mix(ambient_light.y, ambient_light.x, 0.5 + 0.5 * n.y) + sum.x / PI) + sum.y;
}

void main() {
    vec3 n = normalize(gl_FrontFacing ? seen_normal : -seen_normal);
    vec3 v = P[3][3] == 1.0 ? vec3(0.0, 0.0, 1.0) : normalize(-seen_position);
    vec3 color = to_srgb(lit(surface_color(), n, v));
#ifdef TEXCOORD_1_LOC
    // Distance to each edge in pixels; lines fade where triangles are only a few pixels high.
    vec3 wx = dFdx(weights), wy = dFdy(weights);
    vec3 height = inversesqrt(max(wx * wx + wy * wy, vec3(1e-20)));
    float edge_width = ambient_light.z;
    vec3 line = clamp(0.5 * edge_width + 0.5 - weights * height, 0.0, 1.0);
    line *= clamp((height - edge_width) / (5.0 * edge_width), 0.12, 1.0);
    color = mix(color, material.emissive_factor, material.base_color_factor.a * max(line.x, max(line.y, line.z)));
#endif
    frag_color = vec4(color, 1.0);
}
