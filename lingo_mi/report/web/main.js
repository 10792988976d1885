// The page: its parts, its theme, its keys.

const parts = {};

async function start() {
  const known = JSON.parse(document.getElementById('known').textContent);
  const maps = { grey: greys(), ...Object.fromEntries(Object.entries(known.colours).map(([k, v]) => [k, table(v)])) };
  setTheme(matchMedia('(prefers-color-scheme: dark)').matches);
  const arrays = {};
  for (const [name, head] of Object.entries(known.arrays)) {
    const holder = document.getElementById(`array-${name}`);
    arrays[name] = await decode(head, holder.textContent);
    holder.remove();
  }
  await show(known, arrays, maps);
  document.documentElement.dataset.ready = 'yes';
  if (known.live) await follow(known.live, maps);
}

// The parts that something new is known of, one a frame. One that cannot be shown leaves the others alone.
async function show(known, arrays, maps) {
  const make = {
    slices: () => new Slices(body('slices'), known.slices, arrays, maps),
    views: () => new Views(body('views'), known.views, arrays, maps),
    curves: () => new Curves(body('curves'), known.history),
    space: () => new Space(body('space'), known.space, arrays, maps),
  };
  const given = { slices: known.slices, views: known.views, curves: known.history?.length > 1 && known.history, space: known.space };
  for (const [name, build] of Object.entries(make)) {
    if (!given[name]) continue;
    document.getElementById(name).hidden = false;
    await attempt(name, () => {
      if (parts[name]) parts[name].replace(given[name], arrays);
      else parts[name] = build();
    });
    if (!parts[name]) body(name).replaceChildren(text('p', `This part could not be shown: ${failed.get(name)}.`, { class: 'note' }));
    await frame();
  }
}

const failed = new Map();

// What an act gives; where it fails, that is said on the console, once for each name.
async function attempt(name, act) {
  try {
    return await act();
  } catch (error) {
    if (!failed.has(name)) console.error(`${name} could not be shown:`, error);
    failed.set(name, error.message);
    return undefined;
  }
}

// Until a picture may be drawn; a page that nobody sees draws none, so not for long.
function frame() {
  return new Promise((done) => {
    requestAnimationFrame(done);
    setTimeout(done, 100);
  });
}

function body(name) {
  return document.querySelector(`#${name} .body`);
}

function setTheme(dark) {
  document.documentElement.dataset.theme = dark ? 'dark' : 'light';
  document.getElementById('theme').textContent = dark ? 'Light' : 'Dark';
  for (const part of Object.values(parts)) (part.draw || part.paint).call(part);
}

document.getElementById('theme').addEventListener('click', () => setTheme(document.documentElement.dataset.theme !== 'dark'));

function toggleHelp() {
  const help = document.getElementById('help');
  help.hidden = !help.hidden;
  document.getElementById('keys').setAttribute('aria-expanded', String(!help.hidden));
}

document.getElementById('keys').addEventListener('click', toggleHelp);

document.addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches('input, select, textarea')) return;
  if (event.key === '?') toggleHelp();
  else if (parts.slices && /^[1-9osc[\]]$/.test(event.key)) parts.slices.key(event.key);
});

start().catch((error) => {
  const trouble = document.getElementById('trouble');
  trouble.hidden = false;
  trouble.textContent = `This page could not be shown (${error.message}); report.png beside it is a still picture.`;
  throw error;
});
