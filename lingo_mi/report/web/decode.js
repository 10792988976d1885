// Arrays as `lingo_mi.report.packing` writes them.

async function decode(head, text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = bytes.length / 2;
  const codes = new Uint16Array(count);
  let code = 0;
  for (let i = 0; i < count; i++) {
    const folded = bytes[i] | (bytes[count + i] << 8);
    code = (code + ((folded >>> 1) ^ -(folded & 1))) & 0xffff;
    codes[i] = code;
  }
  return { ...head, codes };
}

function valueAt(array, index) {
  return array.low + array.step * array.codes[index];
}

function* eachValue(array) {
  for (const code of array.codes) yield array.low + array.step * code;
}

// Numbers for people: as many digits as the step of the stored values is worth.
function shown(value, step) {
  if (!Number.isFinite(value)) return '–';
  if (value === 0) return '0';
  const size = Math.abs(value);
  if (size < 1e-4 || size >= 1e6) return value.toExponential(3);
  if (!step) return String(Number(value.toPrecision(5)));
  return value.toFixed(Math.min(8, Math.max(0, Math.ceil(-Math.log10(step)))));
}
