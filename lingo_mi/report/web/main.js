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
  show(known, arrays, maps);
  document.documentElement.dataset.ready = 'yes';
  if (known.live) follow(known.live, maps);
}

// Each part on its own: one that a browser cannot show leaves the others alone.
function show(known, arrays, maps) {
  const make = {
    slices: () => new Slices(body('slices'), known.slices, arrays, maps),
    views: () => new Views(body('views'), known.views, arrays, maps),
    curves: () => new Curves(body('curves'), known.history),
    space: () => new Space(body('space'), known.space, arrays, maps),
  };
  const given = { slices: known.slices, views: known.views, curves: known.history.length > 1, space: known.space };
  for (const [name, build] of Object.entries(make)) {
    if (!given[name]) continue;
    document.getElementById(name).hidden = false;
    if (parts[name]) parts[name].replace(name === 'curves' ? known.history : known[name], arrays);
    else parts[name] = build();
  }
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
