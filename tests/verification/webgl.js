// Runs in a page: opens a WebGL 2 context and defines window.evaluate(), which draws one fragment
// per texel of its inputs with each fragment shader. It returns all pixels as base64 of float32.
// The inputs are concatenated in a file, the fastest way to pass several megabytes.
() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl?.getExtension("EXT_color_buffer_float")) throw new Error("no WebGL 2 with float targets");

    function program(...sources) {
        const program = gl.createProgram();
        [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, sources[i]);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
            gl.deleteShader(shader);
            const log = gl.getShaderInfoLog(shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(log);
        });
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
            throw new Error(gl.getProgramInfoLog(program));
        }
        gl.useProgram(program);
        return program;
    }

    const formats = {1: [gl.R32F, gl.RED], 3: [gl.RGB32F, gl.RGB], 4: [gl.RGBA32F, gl.RGBA]};

    function texture(components, width, height, data = null) {
        const texture = gl.createTexture();
        const [format, layout] = formats[components];
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, gl.FLOAT, data);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
        return texture;
    }

    const file = document.body.appendChild(document.createElement("input"));
    file.type = "file";

    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());

    window.evaluate = async ({vertex, fragments, inputs, width, height}) => {
        const data = new Float32Array(await file.files[0].arrayBuffer());
        let read = 0;
        const textures = Object.entries(inputs).map(([name, components], unit) => {
            gl.activeTexture(gl.TEXTURE0 + unit);
            const start = read;
            read += components * width * height;
            return texture(components, width, height, data.subarray(start, read));
        });
        gl.activeTexture(gl.TEXTURE0 + textures.length);
        textures.push(texture(4, width, height));
        gl.framebufferTexture2D(
            gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, textures.at(-1), 0);
        gl.viewport(0, 0, width, height);
        const pixels = new Float32Array(fragments.length * 4 * width * height);
        fragments.forEach((fragment, i) => {
            const used = program(vertex, fragment);
            Object.keys(inputs).forEach((name, unit) =>
                gl.uniform1i(gl.getUniformLocation(used, name), unit));
            gl.drawArrays(gl.TRIANGLES, 0, 3);
            gl.readPixels(
                0, 0, width, height, gl.RGBA, gl.FLOAT, pixels, i * 4 * width * height);
            gl.deleteProgram(used);
        });
        const error = gl.getError();
        if (error) throw new Error(`WebGL error ${error}`);
        textures.forEach(texture => gl.deleteTexture(texture));
        return new Uint8Array(pixels.buffer).toBase64();
    };

    const names = gl.getExtension("WEBGL_debug_renderer_info");
    return [gl.getParameter(names.UNMASKED_RENDERER_WEBGL), gl.getParameter(gl.VERSION)];
}
