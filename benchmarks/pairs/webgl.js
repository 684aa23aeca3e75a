// Opens a WebGL 2 context and defines window.draw(passes). It draws passes like
// facerender/drawing/resources.py, with one sample per pixel, and returns the pixels of the last pass
// as base64 of float32. A file input provides the buffers; an array is [offset, length] in bytes.
() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    const needed = ["EXT_color_buffer_float", "EXT_float_blend"];
    if (!gl || !needed.every(name => gl.getExtension(name))) {
        throw new Error("no WebGL 2 with float targets");
    }
    const file = document.body.appendChild(document.createElement("input"));
    file.type = "file";

    function program(sources) {
        const program = gl.createProgram();
        const stages = {vert: gl.VERTEX_SHADER, frag: gl.FRAGMENT_SHADER};
        for (const [name, kind] of Object.entries(stages)) {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, sources[name]);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
                throw new Error(gl.getShaderInfoLog(shader));
            }
        }
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
            throw new Error(gl.getProgramInfoLog(program));
        }
        gl.useProgram(program);
        return program;
    }

    const kinds = {
        color: [gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, Uint8Array],
        "linear-color": [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, Uint16Array],
        normal: [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, Uint8Array],
        data: [gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, Uint8Array],
        float: [gl.RGB32F, gl.RGB, gl.FLOAT, Float32Array],
    };
    const wraps = {repeat: gl.REPEAT, clamp: gl.CLAMP_TO_EDGE, mirror: gl.MIRRORED_REPEAT};

    function parameters(...values) {
        ["MIN_FILTER", "MAG_FILTER", "WRAP_S", "WRAP_T"].forEach((name, i) =>
            gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], values[i]));
    }

    function map(data, {levels, kind, wrap, step, filtered}) {
        const [internal, layout, type, Values] = kinds[kind];
        gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
        gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
        levels.forEach(({width, height, place}, level) => {
            const texels = new Values(data.slice(place[0], place[0] + place[1]));
            gl.texImage2D(gl.TEXTURE_2D, level, internal, width, height, 0, layout, type, texels);
        });
        const smaller = levels.length === 1 ? gl.LINEAR
            : step ? gl.LINEAR_MIPMAP_NEAREST : gl.LINEAR_MIPMAP_LINEAR;
        const [near, far] = filtered ? [smaller, gl.LINEAR] : [gl.NEAREST, gl.NEAREST];
        parameters(near, far, ...wrap.map(each => wraps[each]));
    }

    function target({size: [width, height], number, clear}) {
        const texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, number ? gl.R32F : gl.RGBA32F, width, height);
        parameters(gl.NEAREST, gl.NEAREST, gl.CLAMP_TO_EDGE, gl.CLAMP_TO_EDGE);
        gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        const depth = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
        gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
        gl.framebufferRenderbuffer(
            gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
        gl.depthMask(true);
        gl.clearBufferfv(gl.COLOR, 0, clear);
        gl.clearBufferfv(gl.DEPTH, 0, [1]);
        return texture;
    }

    const setters = new Map([
        [gl.FLOAT, "uniform1fv"], [gl.FLOAT_VEC2, "uniform2fv"], [gl.FLOAT_VEC3, "uniform3fv"],
        [gl.FLOAT_VEC4, "uniform4fv"], [gl.INT, "uniform1iv"], [gl.INT_VEC2, "uniform2iv"],
        [gl.FLOAT_MAT3, "uniformMatrix3fv"], [gl.FLOAT_MAT4, "uniformMatrix4fv"],
    ]);

    function setUniforms(used, values, textures) {
        let unit = 0;
        for (let i = 0; i < gl.getProgramParameter(used, gl.ACTIVE_UNIFORMS); ++i) {
            const {name, type, size} = gl.getActiveUniform(used, i);
            const place = gl.getUniformLocation(used, name);
            if (type === gl.SAMPLER_2D) {
                gl.activeTexture(gl.TEXTURE0 + unit);
                textures[name]();
                gl.uniform1i(place, unit++);
                continue;
            }
            const setter = setters.get(type), value = values[name.replace("[0]", "")];
            if (value === undefined) continue;  // stays 0, the default
            if (setter.includes("Matrix")) gl[setter](place, false, value);
            else gl[setter](place, value);
        }
    }

    function attributes(used, data, columns, faces) {
        gl.bindVertexArray(gl.createVertexArray());
        for (const [name, {width, place: [start, length]}] of Object.entries(columns)) {
            const at = gl.getAttribLocation(used, name);
            if (at < 0) continue;
            gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
            gl.bufferData(gl.ARRAY_BUFFER, data.slice(start, start + length), gl.STATIC_DRAW);
            gl.enableVertexAttribArray(at);
            gl.vertexAttribPointer(at, width, gl.FLOAT, false, 0, 0);
        }
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(
            gl.ELEMENT_ARRAY_BUFFER, data.slice(faces[0], faces[0] + faces[1]), gl.STATIC_DRAW);
    }

    window.draw = async passes => {
        const data = await file.files[0].arrayBuffer();
        const drawn = {};
        for (const pass of passes) {
            const texture = target(pass);
            gl.enable(gl.DEPTH_TEST);
            gl.depthFunc(gl.LEQUAL);
            for (const {sources, uniforms, maps, columns, faces, area, blend} of pass.draws) {
                const used = program(sources);
                const textures = {};
                for (const [name, own] of Object.entries(maps)) textures[name] = () => map(data, own);
                for (const [name, own] of Object.entries(drawn)) {
                    textures[name] = () => gl.bindTexture(gl.TEXTURE_2D, own);
                }
                setUniforms(used, uniforms, textures);
                attributes(used, data, columns, faces);
                gl.viewport(...area);
                gl.depthMask(!blend);
                gl[blend ? "enable" : "disable"](gl.BLEND);
                gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
                gl.drawElements(gl.TRIANGLES, faces[1] / 4, gl.UNSIGNED_INT, 0);
            }
            drawn[pass.name] = texture;
        }
        const [width, height] = passes.at(-1).size;
        const pixels = new Float32Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, pixels);
        const error = gl.getError();
        if (error) throw new Error(`WebGL error ${error}`);
        return new Uint8Array(pixels.buffer).toBase64();
    };

    const names = gl.getExtension("WEBGL_debug_renderer_info");
    return gl.getParameter(names.UNMASKED_RENDERER_WEBGL);
}
