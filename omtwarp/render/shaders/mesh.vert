#version 330 core
// The Warp ray caster does the same computation, with the same names, in ray_kernels.py.
// pyrender's own defines decide which parts are compiled: HAS_BASE_COLOR_TEX with TEXCOORD_0_LOC is an image with
// texture coordinates, HAS_BASE_COLOR_TEX with COLOR_0_LOC an equirectangular image with points of the sphere,
// COLOR_0_LOC alone a colour; TEXCOORD_1_LOC carries two barycentric coordinates where edges are drawn.

layout(location = 0) in vec3 position;
layout(location = NORMAL_LOC) in vec3 normal;
#ifdef TEXCOORD_0_LOC
layout(location = TEXCOORD_0_LOC) in vec2 texcoord;
out vec2 at;
#endif
#ifdef TEXCOORD_1_LOC
layout(location = TEXCOORD_1_LOC) in vec2 corner;
out vec2 inside;
#endif
#ifdef COLOR_0_LOC
layout(location = COLOR_0_LOC) in vec4 value;
out vec3 carried;
#endif
layout(location = INST_M_LOC) in mat4 instance;

uniform mat4 V;
uniform mat4 P;

out vec3 seen_position;
out vec3 seen_normal;

void main()
{
    vec4 seen = V * vec4(position, 1.0);
    gl_Position = P * seen;
    seen_position = seen.xyz;
    seen_normal = mat3(V) * normal;
#ifdef TEXCOORD_0_LOC
    at = texcoord;
#endif
#ifdef TEXCOORD_1_LOC
    inside = corner;
#endif
#ifdef COLOR_0_LOC
    carried = value.xyz;
#endif
}
