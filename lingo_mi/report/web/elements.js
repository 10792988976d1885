// Small helpers for the document. Text is always set as text, never as markup.

function element(name, attributes = {}) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function text(name, content, attributes = {}) {
  const made = element(name, attributes);
  made.textContent = content;
  return made;
}

function button(label, pressed, act) {
  const made = text('button', label, { type: 'button', 'aria-pressed': String(pressed) });
  made.addEventListener('click', () => act(made));
  return made;
}

// Buttons of which one is pressed.
function choice(name, labels, start, act) {
  const group = element('fieldset', { class: 'group' });
  const buttons = labels.map((label, i) => button(label, i === start, () => act(i)));
  group.append(text('span', name), ...buttons);
  group.setAttribute('aria-label', name);
  group.choose = (chosen) => buttons.forEach((b, i) => b.setAttribute('aria-pressed', String(i === chosen)));
  return group;
}

function slider(name, low, high, step, value, act) {
  const label = element('label');
  const input = element('input', { type: 'range', min: low, max: high, step });
  input.value = value;
  const output = element('output');
  label.append(text('span', name), input, output);
  input.addEventListener('input', () => act(Number(input.value)));
  label.set = (now, said) => {
    input.value = now;
    output.textContent = said;
    input.setAttribute('aria-valuetext', said);
  };
  return label;
}

// Draw once a frame, however often it is asked for.
function onceAFrame(draw) {
  let waiting = false;
  return () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      draw();
    });
  };
}

// A canvas with as many pixels as the screen has for it.
function fit(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return ratio;
}

function colourOf(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
