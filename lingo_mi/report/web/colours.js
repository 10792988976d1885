// Colour maps as tables of 32-bit pixels (little-endian: alpha, blue, green, red).

function table(digits) {
  const out = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const rgb = parseInt(digits.substr(6 * i, 6), 16);
    out[i] = 0xff000000 | ((rgb & 0xff) << 16) | (rgb & 0xff00) | (rgb >> 16);
  }
  return out;
}

function greys() {
  return Uint32Array.from({ length: 256 }, (_, i) => (0xff000000 | (i << 16) | (i << 8) | i) >>> 0);
}

// For each of 65536 codes its pixel, where values from low to high take the whole map.
function pixelsOfCodes(map, array, low, high) {
  const out = new Uint32Array(65536);
  const scale = 256 / (high - low || 1e-12);
  for (let code = 0; code < 65536; code++) {
    const place = Math.floor((array.low + array.step * code - low) * scale);
    out[code] = map[Math.min(255, Math.max(0, place))];
  }
  return out;
}

// For each difference of two codes, from -65535 to 65535, its pixel.
function pixelsOfDifferences(map, step, largest, absolute) {
  const out = new Uint32Array(131071);
  for (let d = -65535; d <= 65535; d++) {
    const value = (d * step) / (largest || 1e-12);
    const place = Math.floor(absolute ? Math.abs(value) * 256 : (value + 1) * 128);
    out[d + 65535] = map[Math.min(255, Math.max(0, place))];
  }
  return out;
}

// A bar that says what the colours mean.
function scaleBar(map, label, low, high) {
  const box = element('div');
  const canvas = element('canvas', { class: 'scale', width: 256, height: 1, 'aria-hidden': 'true' });
  const pen = canvas.getContext('2d');
  const image = pen.createImageData(256, 1);
  new Uint32Array(image.data.buffer).set(map);
  pen.putImageData(image, 0, 0);
  const ends = element('span');
  ends.append(text('b', shown(low, (high - low) / 1e3)), text('i', label), text('b', shown(high, (high - low) / 1e3)));
  box.append(canvas, ends);
  return box;
}
