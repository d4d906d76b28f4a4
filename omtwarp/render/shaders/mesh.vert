#version 330 core
// The Warp ray caster does the same computation, with the same names, in ray_caster.py.

layout(location = 0) in vec3 position;
layout(location = NORMAL_LOC) in vec3 normal;
layout(location = COLOR_0_LOC) in vec4 value;  // a colour, texture coordinates, or a point of the sphere

uniform mat4 V, P;

out vec3 seen_position, seen_normal, carried, weights;

void main() {
    vec4 seen = V * vec4(position, 1.0);
    gl_Position = P * seen;
    seen_position = seen.xyz;
    seen_normal = mat3(V) * normal;
    carried = value.xyz;
    weights = vec3(equal(ivec3(gl_VertexID % 3), ivec3(0, 1, 2)));  // where edges are drawn, corners have their own rows
}
