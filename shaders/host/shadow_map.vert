// Places in the space of a light that casts shadows: see facerender/shadow.glsl.
in vec3 in_position;

uniform mat4 to_light;
uniform float top;  // largest z there

out vec4 place;

void main() {
    place = to_light * vec4(in_position, 1.0);
    gl_Position = vec4(place.xy, -place.z / top, place.w);
}
