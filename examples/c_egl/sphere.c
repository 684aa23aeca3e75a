/* Renders ../sphere.frag without a window, with EGL and OpenGL 3.3 core:
 *
 *     ./sphere OUT.ppm [X,Y ...]
 *
 * Writes the sRGB-encoded image. Prints the specular radiance of each pixel X,Y as "X Y VALUE"; row
 * 0 is at the top. */
#define GL_GLEXT_PROTOTYPES
#include <EGL/egl.h>
#include <EGL/eglext.h>
#include <GL/glcorearb.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { SIZE = 512, CHANNELS = 4, SPECULAR = 3 };

/* One string per line, from the Makefile. */
static const char *const vertex_lines[] = {
#include "sphere.vert.inc"
};
static const char *const fragment_lines[] = {
#include "sphere.frag.inc"
};
#define COUNT(array) ((GLsizei)(sizeof(array) / sizeof *(array)))

static float pixels[SIZE][SIZE][CHANNELS]; /* in OpenGL's order: row 0 at the bottom */

static void fail(const char *what, unsigned code) {
    fprintf(stderr, "sphere: %s (0x%x)\n", what, code);
    exit(EXIT_FAILURE);
}

static void require_egl(int success, const char *call) {
    if (!success) {
        fail(call, (unsigned)eglGetError());
    }
}

static void require_gl(const char *what) {
    GLenum error = glGetError();
    if (error != GL_NO_ERROR) {
        fail(what, error);
    }
}

static void make_context_current(void) {
    static const EGLint attributes[] = {
        EGL_CONTEXT_MAJOR_VERSION, 3, EGL_CONTEXT_MINOR_VERSION, 3,
        EGL_CONTEXT_OPENGL_PROFILE_MASK, EGL_CONTEXT_OPENGL_CORE_PROFILE_BIT, EGL_NONE,
    };
    EGLDisplay display = eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, NULL, NULL);
    require_egl(display != EGL_NO_DISPLAY, "no display: eglGetPlatformDisplay");
    require_egl(eglInitialize(display, NULL, NULL), "no display: eglInitialize");
    require_egl(eglBindAPI(EGL_OPENGL_API), "no OpenGL: eglBindAPI");
    EGLContext context =
        eglCreateContext(display, EGL_NO_CONFIG_KHR, EGL_NO_CONTEXT, attributes);
    require_egl(context != EGL_NO_CONTEXT, "no OpenGL 3.3 core: eglCreateContext");
    require_egl(eglMakeCurrent(display, EGL_NO_SURFACE, EGL_NO_SURFACE, context),
                "context not current: eglMakeCurrent");
}

static void attach(GLuint program, GLenum kind, const char *const *lines, GLsizei count) {
    GLuint shader = glCreateShader(kind);
    GLint compiled;
    glShaderSource(shader, count, lines, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &compiled);
    if (!compiled) {
        char log[4096];
        glGetShaderInfoLog(shader, sizeof log, NULL, log);
        fputs(log, stderr);
        fail("shader does not compile", kind);
    }
    glAttachShader(program, shader);
    glDeleteShader(shader);
}

static void use_program(void) {
    GLuint program = glCreateProgram();
    GLint linked;
    attach(program, GL_VERTEX_SHADER, vertex_lines, COUNT(vertex_lines));
    attach(program, GL_FRAGMENT_SHADER, fragment_lines, COUNT(fragment_lines));
    glLinkProgram(program);
    glGetProgramiv(program, GL_LINK_STATUS, &linked);
    if (!linked) {
        char log[4096];
        glGetProgramInfoLog(program, sizeof log, NULL, log);
        fputs(log, stderr);
        fail("program does not link", glGetError());
    }
    glUseProgram(program);
}

static void draw(void) {
    GLuint framebuffer, colour, vertices;
    glGenRenderbuffers(1, &colour);
    glBindRenderbuffer(GL_RENDERBUFFER, colour);
    glRenderbufferStorage(GL_RENDERBUFFER, GL_RGBA32F, SIZE, SIZE);
    glGenFramebuffers(1, &framebuffer);
    glBindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    glFramebufferRenderbuffer(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_RENDERBUFFER, colour);
    GLenum status = glCheckFramebufferStatus(GL_FRAMEBUFFER);
    if (status != GL_FRAMEBUFFER_COMPLETE) {
        fail("no float framebuffer", status);
    }
    glViewport(0, 0, SIZE, SIZE);
    glGenVertexArrays(1, &vertices);
    glBindVertexArray(vertices);
    use_program();
    glDrawArrays(GL_TRIANGLES, 0, 3);
    glReadPixels(0, 0, SIZE, SIZE, GL_RGBA, GL_FLOAT, pixels);
    require_gl("OpenGL error");
}

static int srgb_byte(float linear) {
    float x = fminf(fmaxf(linear, 0.0f), 1.0f);
    float encoded = x <= 0.0031308f ? 12.92f * x : 1.055f * powf(x, 1.0f / 2.4f) - 0.055f;
    return (int)lrintf(255.0f * encoded);
}

static void write_ppm(const char *path) {
    FILE *file = fopen(path, "wb");
    if (!file) {
        perror(path);
        exit(EXIT_FAILURE);
    }
    fprintf(file, "P6\n%d %d\n255\n", SIZE, SIZE);
    for (int y = SIZE; y-- > 0;) {
        for (int x = 0; x < SIZE; x++) {
            for (int channel = 0; channel < 3; channel++) {
                putc(srgb_byte(pixels[y][x][channel]), file);
            }
        }
    }
    int failed = ferror(file);
    if (fclose(file) || failed) {
        perror(path);
        exit(EXIT_FAILURE);
    }
}

int main(int count, char **arguments) {
    if (count < 2) {
        fputs("usage: sphere OUT.ppm [X,Y ...]\n", stderr);
        return EXIT_FAILURE;
    }
    make_context_current();
    draw();
    for (int i = 2; i < count; i++) {
        int x, y;
        char rest;
        if (sscanf(arguments[i], "%d,%d%c", &x, &y, &rest) != 2 || x < 0 || x >= SIZE || y < 0 ||
            y >= SIZE) {
            fprintf(stderr, "sphere: %s is not a pixel X,Y from 0 to %d\n", arguments[i], SIZE - 1);
            return EXIT_FAILURE;
        }
        printf("%d %d %.9g\n", x, y, (double)pixels[SIZE - 1 - y][x][SPECULAR]);
    }
    write_ppm(arguments[1]);
    return EXIT_SUCCESS;
}
