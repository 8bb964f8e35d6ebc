/** Up and down in a menu, around its ends. */
export function moveInMenu(event: KeyboardEvent, menu: HTMLElement | null): boolean {
  const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (by === undefined || menu === null) return false;
  event.preventDefault();
  event.stopPropagation();
  const buttons = [...menu.querySelectorAll<HTMLButtonElement>("[role=menuitem]:not(:disabled)")];
  const at = buttons.indexOf(document.activeElement as HTMLButtonElement);
  buttons[(at + by + buttons.length) % buttons.length]?.focus();
  return true;
}
