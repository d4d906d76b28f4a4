#version 330 core
// The Warp ray caster does the same computation, with the same names, in ray_caster.py.
// UNLIT and SINGLE_LEVEL are defined by pyrender_renderer.py, the other names by pyrender.

struct Material { vec4 base_color_factor; float roughness_factor; sampler2D base_color_texture; };

uniform Material material;
uniform mat4 lights;  // a column each: where it is, of unit length, seen from the camera, and its power
uniform int light_count;
uniform mat4 P;
uniform vec3 sky;
uniform vec3 ground;
uniform vec3 edge_color;
uniform float edge_width;
uniform float edge_opacity;

in vec3 seen_position;
in vec3 seen_normal;
#ifdef TEXCOORD_0_LOC
in vec2 at;
#endif
#ifdef TEXCOORD_1_LOC
in vec2 inside;
#endif
#ifdef COLOR_0_LOC
in vec3 carried;
#endif

out vec4 frag_color;

const float PI = 3.14159265358979;
const float MOST_PROBES = 48.0;

vec3 to_linear(vec3 c)
{
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(vec3(0.04045), c));
}

vec3 to_srgb(vec3 c)
{
    c = clamp(c, 0.0, 1.0);
    return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(vec3(0.0031308), c));
}

#ifdef HAS_BASE_COLOR_TEX
// The mean of the image over the pixel: its footprint is the ellipse that the derivatives span; probes along the long
// axis, each from the mip level of the short one. The hardware's own anisotropic filter takes the two derivatives
// for the axes, which blurs the poles along the diagonals, where the derivatives are long, alike and nearly parallel.
vec3 filtered(vec2 uv, vec2 along_x, vec2 along_y)
{
    vec2 size = vec2(textureSize(material.base_color_texture, 0));
    vec2 a = along_x * size;
    vec2 b = along_y * size;
    float xx = a.x * a.x + b.x * b.x;
    float yy = a.y * a.y + b.y * b.y;
    float xy = a.x * a.y + b.x * b.y;
    float half_gap = 0.5 * (xx - yy);
    float root = sqrt(half_gap * half_gap + xy * xy);
    float middle = 0.5 * (xx + yy);
    float longest = sqrt(middle + root);
    // The determinant, not middle - root, which cancels where the ellipse is thin.
    float shortest = abs(a.x * b.y - a.y * b.x) / max(longest, 1e-12);
    vec2 axis = half_gap >= 0.0 ? vec2(half_gap + root, xy) : vec2(xy, root - half_gap);
    axis = dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
    float probes = clamp(ceil(longest / max(shortest, 1.0)), 1.0, MOST_PROBES);
    float level = log2(max(max(shortest, longest / probes), 1.0));
    vec2 stride = axis * longest / (size * probes);
    vec2 first = uv - 0.5 * (probes - 1.0) * stride;
    vec3 sum = vec3(0.0);
    for (int k = 0; k < int(probes); ++k)
        sum += textureLod(material.base_color_texture, first + float(k) * stride, level).rgb;
    return sum / probes;
}
#endif

vec3 surface_color()
{
#ifdef HAS_BASE_COLOR_TEX
#ifdef COLOR_0_LOC
    // Longitude and latitude with their derivatives by the chain rule: no branch cut, hence no seam.
    vec3 p = carried;
    vec3 px = dFdx(p);
    vec3 py = dFdy(p);
    float across = max(dot(px, px), dot(py, py));
    // Within a quarter of a pixel of a pole the footprint is the whole parallel; the bound keeps it finite.
    float rho2 = max(dot(p.xy, p.xy), max(0.0625 * across, 1e-20));
    float rho = sqrt(rho2);
    float r2 = rho2 + p.z * p.z;
    vec2 longitude = vec2(p.x * px.y - p.y * px.x, p.x * py.y - p.y * py.x) / rho2;
    vec2 outward = vec2(dot(p.xy, px.xy), dot(p.xy, py.xy)) / rho;
    vec2 latitude = (rho * vec2(px.z, py.z) - p.z * outward) / r2;
    float angle = dot(p.xy, p.xy) > 0.0 ? atan(p.y, p.x) : 0.0;
    vec2 uv = vec2(0.5 + angle / (2.0 * PI), 0.5 + atan(p.z, sqrt(dot(p.xy, p.xy))) / PI);
    longitude /= 2.0 * PI;
    latitude /= PI;
    vec3 found = filtered(uv, vec2(longitude.x, latitude.x), vec2(longitude.y, latitude.y));
#else
#ifdef SINGLE_LEVEL
    vec3 found = textureLod(material.base_color_texture, at, 0.0).rgb;
#else
    vec3 found = filtered(at, dFdx(at), dFdy(at));
#endif
#endif
    return found * to_linear(material.base_color_factor.rgb);
#else
#ifdef COLOR_0_LOC
    return to_linear(carried);
#else
    return to_linear(material.base_color_factor.rgb);
#endif
#endif
}

#ifndef UNLIT
// Lambert's diffuse term and a GGX highlight with Schlick's Fresnel and Smith's shadowing, as glTF 2.0, appendix B.
// With h = (l + v) / |l + v| and |l + v|² = 2 (1 + l.v) all angles come from n.l, n.v and l.v.
vec3 lit(vec3 albedo, vec3 n, vec3 v)
{
    float alpha2 = material.roughness_factor * material.roughness_factor;
    alpha2 *= alpha2;
    float k = (material.roughness_factor + 1.0) * (material.roughness_factor + 1.0) / 8.0;
    float facing = dot(n, v);
    float shadow = min(max(abs(facing), 0.001), 1.0) * (1.0 - k) + k;
    float gloss = alpha2 / (4.0 * PI);
    float diffuse = 0.0;
    float shine = 0.0;
    for (int i = 0; i < light_count; ++i)
    {
        float incident = dot(n, lights[i].xyz);
        float nl = clamp(incident, 0.0, 1.0);
        float both = 1.0 + dot(v, lights[i].xyz);
        float scale = inversesqrt(max(2.0 * both, 1e-6));
        float nh = clamp((incident + facing) * scale, 0.0, 1.0);
        float away = 1.0 - clamp(both * scale, 0.0, 1.0);
        float fresnel = 0.04 + 0.96 * (away * away) * (away * away) * away;
        float spread = nh * nh * (alpha2 - 1.0) + 1.0;
        float power = nl * lights[i].w;
        diffuse += power * (1.0 - fresnel);
        shine += power * fresnel * gloss / (spread * spread * (nl * (1.0 - k) + k) * shadow);
    }
    return albedo * (mix(ground, sky, 0.5 + 0.5 * n.y) + diffuse / PI) + shine;
}
#endif

void main()
{
    vec3 color = surface_color();
#ifndef UNLIT
    vec3 n = normalize(gl_FrontFacing ? seen_normal : -seen_normal);
    vec3 v = P[3][3] == 1.0 ? vec3(0.0, 0.0, 1.0) : normalize(-seen_position);
    color = lit(color, n, v);
#endif
    color = to_srgb(color);
#ifdef TEXCOORD_1_LOC
    // Distance to each edge in pixels; lines fade where triangles are only a few pixels high.
    vec3 weights = vec3(inside, 1.0 - inside.x - inside.y);
    vec3 wx = dFdx(weights);
    vec3 wy = dFdy(weights);
    vec3 height = inversesqrt(max(wx * wx + wy * wy, vec3(1e-20)));
    vec3 line = clamp(0.5 * edge_width + 0.5 - weights * height, 0.0, 1.0);
    line *= clamp((height - edge_width) / (5.0 * edge_width), 0.12, 1.0);
    color = mix(color, edge_color, edge_opacity * max(line.x, max(line.y, line.z)));
#endif
    frag_color = vec4(color, 1.0);
}
