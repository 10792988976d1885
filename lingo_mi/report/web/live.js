// Of a page that follows a fit: asks the server that sent it, until the fit ends or does not answer any more.

async function follow(live, maps) {
  const line = document.getElementById('live');
  line.hidden = false;
  let seen = 0;
  let failures = 0;
  while (failures < 5) {
    try {
      const answer = await fetch(`state?token=${live.token}&seen=${seen}`, { cache: 'no-store' });
      if (!answer.ok) throw new Error(answer.statusText);
      const state = await answer.json();
      failures = 0;
      line.textContent = state.line;
      if (state.number > seen) {
        seen = state.number;
        const arrays = {};
        for (const [name, head] of Object.entries(state.known.arrays)) arrays[name] = await decode(head, state.texts[name]);
        show(state.known, arrays, maps);
      }
      if (state.done) return;
    } catch {
      failures += 1;
    }
    await new Promise((done) => setTimeout(done, live.milliseconds));
  }
  line.textContent += ' The fit does not answer any more: it has ended, or was stopped.';
}
