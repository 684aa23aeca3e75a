// Reads the data of the page: facts, arrays of the mesh, GLSL, maps. explorer/page.py writes them.
const facts = JSON.parse(document.getElementById("facts").textContent);
const {registry} = facts;

async function stored(id, kind) {
  const text = document.getElementById(id).textContent;
  return (await fetch(`data:${kind};base64,${text}`)).blob();
}

async function inflated(id) {
  const blob = await stored(id, "application/octet-stream");
  return new Response(blob.stream().pipeThrough(new DecompressionStream("deflate")));
}

// Decodes integers (N, K); explorer/mesh.py encodes them.
function unpacked(bytes, start, [rows, width]) {
  const count = rows * width;
  const values = new Int32Array(count);
  const [low, second, third, high] = [0, 1, 2, 3].map(plane =>
    bytes.subarray(start + plane * count, start + (plane + 1) * count));
  for (let i = 0; i < count; ++i) {
    const folded = low[i] | second[i] << 8 | third[i] << 16 | high[i] << 24;
    values[i] = (folded >>> 1 ^ -(folded & 1)) + (i < width ? 0 : values[i - width]);
  }
  return values;
}

function normals(packed) {
  const vectors = new Float32Array(packed.length / 2 * 3);
  for (let i = 0; i < packed.length / 2; ++i) {
    let x = packed[2 * i] / facts.steps.normal;
    let y = packed[2 * i + 1] / facts.steps.normal;
    const z = 1 - Math.abs(x) - Math.abs(y);
    if (z < 0) {
      [x, y] = [(1 - Math.abs(y)) * (x < 0 ? -1 : 1), (1 - Math.abs(x)) * (y < 0 ? -1 : 1)];
    }
    const scale = 1 / Math.hypot(x, y, z);
    vectors.set([x * scale, y * scale, z * scale], 3 * i);
  }
  return vectors;
}

// Returns each part with the arrays for the renderer's vertex shader, and the part's triangles.
async function meshParts() {
  const bytes = new Uint8Array(await (await inflated("geometry")).arrayBuffer());
  const columns = [];
  let read = 0;
  for (const shape of facts.columns) {
    columns.push(unpacked(bytes, read, shape));
    read += 4 * shape[0] * shape[1];
  }
  return facts.parts.map(part => {
    const {position, normal, faces, uv, color, occlusion} = part.arrays;
    const scaled = (column, factor, offset = 0) =>
      Float32Array.from(columns[column], x => x * factor + offset);
    const attributes = {
      in_position: [3, scaled(position, 2 / facts.steps.position, -1)],
      in_normal: [3, normals(columns[normal])],
    };
    if (uv !== undefined) {
      const [corner, extent] = part.uv;
      attributes.in_uv = [2, Float32Array.from(columns[uv], (x, i) =>
        corner[i % 2] + x / facts.steps.uv * extent[i % 2])];
    }
    if (color !== undefined) attributes.in_color = [3, scaled(color, 1 / facts.steps.vertex)];
    if (occlusion !== undefined) attributes.in_occlusion = [1, scaled(occlusion, 1 / facts.steps.vertex)];
    return {...part, attributes, triangles: Uint32Array.from(columns[faces])};
  });
}

async function mapImages() {
  return Promise.all(facts.maps.map(async (map, i) => {
    const blob = await stored(`map-${i}`, "image/*");
    const asStored = {colorSpaceConversion: "none", premultiplyAlpha: "none"};
    return {...map, image: await createImageBitmap(blob, asStored)};
  }));
}
