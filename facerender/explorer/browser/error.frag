out vec4 error;

void main() { error = error_at(ivec2(gl_FragCoord.xy)); }
