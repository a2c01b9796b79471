// Say plainly why there is nothing to see.

export function sorry(text, remedy) {
  document.getElementById('splash').classList.remove('gone');
  const card = document.querySelector('#splash .card');
  card.classList.add('sorry');
  card.replaceChildren(
    ...[
      ['h1', 'This page cannot be shown'],
      ['p', text],
      ['p', remedy],
    ].map(([tag, content]) => Object.assign(document.createElement(tag), { textContent: content })),
  );
}
