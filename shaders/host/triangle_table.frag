// Triangle table: the plane of each triangle of a part, and its attributes as affine functions of
// the position. visible.glsl reads this table.
//
// The first texel of a triangle holds the unit normal of its plane and the plane's distance from the
// origin. A row has the first texels of all its triangles before the others, because depth images
// need only these. Each further texel holds an attribute's gradient and its value at the origin:
// first the normal, then the fixed attributes, and last the dot product of position and normal.
//
// A triangle may be narrower than the rounding error of its positions, for example in a filled
// T-junction. Then its attributes vary only along its length, and its first vertex determines the
// normal.
#define ROUNDING exp2(-22.0)  // rounding error of a position of magnitude 1
#define NORMAL_END 3
#define LAST (TRIANGLE_TEXELS - 1)

uniform sampler2D vertices;  // Two texels per vertex: position, normal.
uniform sampler2D attributes;  // ATTRIBUTE_TEXELS per vertex: the fixed attributes.
uniform isampler2D faces;  // Indices of the vertices of each triangle.
out vec4 texel;

vec3 texel_of(sampler2D map, int texels, int vertex, int index) {
    int row = vertex / VERTICES_IN_ROW;
    int column = (vertex - row * VERTICES_IN_ROW) * texels + index;
    return texelFetch(map, ivec2(column, row), 0).xyz;
}

vec3 position_of(int vertex) { return texel_of(vertices, 2, vertex, 0); }
vec3 normal_of(int vertex) { return texel_of(vertices, 2, vertex, 1); }

float value_of(int vertex, vec3 position, int index) {
    if (index == LAST) return dot(position, normal_of(vertex));
    if (index <= NORMAL_END) return normal_of(vertex)[index - 1];
    int place = index - NORMAL_END - 1;
    return texel_of(attributes, ATTRIBUTE_TEXELS, vertex, place / 3)[place % 3];
}

void main() {
    int column = int(gl_FragCoord.x);
    int triangle = column;
    int index = 0;
    if (column >= TRIANGLES_IN_ROW) {
        triangle = (column - TRIANGLES_IN_ROW) / LAST;
        index = 1 + column - TRIANGLES_IN_ROW - triangle * LAST;
    }
    ivec3 face = texelFetch(faces, ivec2(triangle, int(gl_FragCoord.y)), 0).xyz;
    vec3 a = position_of(face.x);
    vec3 b = position_of(face.y);
    vec3 c = position_of(face.z);
    vec3 u = b - a;
    vec3 v = c - a;
    vec3 normal = cross(u, v);
    vec3 largest = max(max(abs(a), abs(b)), abs(c));
    float width = ROUNDING * max(max(largest.x, largest.y), max(largest.z, 1e-6));
    float hidden = width * width;
    float lengths = dot(u, u) + dot(v, v) + hidden;
    float least = hidden * lengths;
    if (dot(normal, normal) <= least) normal = vec3(0.0);
    if (index == 0) {
        vec3 own = normal_of(face.x);
        vec3 along = (u * dot(u, own) + v * dot(v, own)) / lengths;
        normal = normalize(normal + sqrt(least) * (own - along));
        texel = vec4(normal, dot(normal, a));
        return;
    }
    float value = value_of(face.x, a, index);
    float change_u = value_of(face.y, b, index) - value;
    float change_v = value_of(face.z, c, index) - value;
    vec3 gradient = change_u * (cross(v, normal) + hidden * u) + change_v * (cross(normal, u) + hidden * v);
    gradient /= max(dot(normal, normal) + least, 1e-37);
    texel = vec4(gradient, value - dot(gradient, a));
}
