// Of a page that follows a fit: asks the server that sent it, until the fit ends or does not answer any more.

const PATIENCE = 30_000; // milliseconds for an answer
const MOST_FAILURES = 5;

async function follow(live, maps) {
  const line = document.getElementById('live');
  const main = document.getElementById('main');
  line.hidden = false;
  const arrays = {};
  let seen = 0;
  let history = [];
  let place = '';
  let failures = 0;
  while (failures < MOST_FAILURES) {
    const said = await answer(`state${location.search}&seen=${seen}&history=${place}`);
    if (said === null) failures += 1;
    else {
      failures = 0;
      const state = JSON.parse(said);
      line.textContent = state.line; // before the pictures, which may take long
      seen = state.number;
      history = state.history.whole ? state.history.entries : [...history, ...state.history.entries];
      place = state.history.place;
      main.setAttribute('aria-busy', 'true');
      for (const [name, text] of Object.entries(state.texts || {})) {
        arrays[name] = await attempt(`array ${name}`, () => decode(state.known.arrays[name], text));
      }
      const news = state.history.entries.length ? { ...state.known, history } : state.known || {};
      await show(news, arrays, maps);
      main.setAttribute('aria-busy', 'false');
      if (state.done) return;
    }
    await new Promise((done) => setTimeout(done, live.milliseconds));
  }
  line.textContent += ' The fit does not answer any more: it has ended, or was stopped.';
}

// The text at an address; null where there is no answer.
async function answer(address) {
  try {
    const found = await fetch(address, { cache: 'no-store', signal: AbortSignal.timeout(PATIENCE) });
    return found.ok ? await found.text() : null;
  } catch {
    return null;
  }
}
