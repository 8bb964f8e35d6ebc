/** Small pictures for buttons, drawn in the colour of the text. */

const PATHS = {
  play: "M5 3.5v9l7.5-4.5z",
  pause: "M4.5 3.5h2.5v9h-2.5zM9 3.5h2.5v9h-2.5z",
  step: "M4 4l5 4-5 4zM10.5 4h1.6v8h-1.6z",
  "step-back": "M12 4l-5 4 5 4zM3.9 4h1.6v8h-1.6z",
  change: "M3 4l4.5 4-4.5 4zM7.8 4l4.5 4-4.5 4z",
  "change-back": "M13 4l-4.5 4 4.5 4zM8.2 4l-4.5 4 4.5 4z",
  merge: "M2.8 3.2h1.9l3 3.6h.9V4.6L13.2 8l-4.6 3.4V9.2h-.9l-3 3.6H2.8L6.7 8z",
  "merge-back": "M13.2 3.2h-1.9l-3 3.6h-.9V4.6L2.8 8l4.6 3.4V9.2h.9l3 3.6h1.9L9.3 8z",
  plus: "M7.25 3h1.5v4.25H13v1.5H8.75V13h-1.5V8.75H3v-1.5h4.25z",
  minus: "M3 7.25h10v1.5H3z",
  fit: "M2.5 2.5h4V4H4v2.5H2.5zM9.5 2.5h4v4H12V4H9.5zM2.5 9.5H4V12h2.5v1.5h-4zM12 9.5h1.5v4h-4V12H12z",
  back: "M7.6 3.2 8.7 4.3 5.8 7.25H13v1.5H5.8l2.9 2.95-1.1 1.1L2.9 8z",
  close: "M4.3 3.2 8 6.9l3.7-3.7 1.1 1.1L9.1 8l3.7 3.7-1.1 1.1L8 9.1l-3.7 3.7-1.1-1.1L6.9 8 3.2 4.3z",
  search: "M7 2.5a4.5 4.5 0 1 0 2.7 8.1l3 3 1.1-1.1-3-3A4.5 4.5 0 0 0 7 2.5zM7 4a3 3 0 1 1 0 6 3 3 0 0 1 0-6z",
  sun: "M8 5a3 3 0 1 1 0 6 3 3 0 0 1 0-6zM7.4 1h1.2v2.4H7.4zM7.4 12.6h1.2V15H7.4zM1 7.4h2.4v1.2H1zM12.6 7.4H15v1.2h-2.4zM3 3.9l.9-.9 1.6 1.7-.8.8zM10.5 11.3l.8-.8L13 12.1l-.9.9zM10.5 4.7 12.1 3l.9.9-1.7 1.6zM3 12.1l1.7-1.6.8.8L3.9 13z",
  moon: "M6.5 2.2A6 6 0 1 0 13.8 9.5 5 5 0 0 1 6.5 2.2z",
  out: "M7.25 2h1.5v6l2-2 1 1L8 10.8 4.2 7l1-1 2.05 2zM2.5 11H4v1.5h8V11h1.5v3h-11z",
  copy: "M5 2h8v9h-2v-1.5h.5v-6h-5V4H5zM3 5h7v9H3zm1.5 1.5v6h4v-6z",
  help: "M5 6a3 3 0 1 1 4.3 2.7c-.4.2-.55.4-.55.9H7.2c0-1.3.5-1.8 1.3-2.2A1.5 1.5 0 1 0 6.5 6zM7.2 11h1.6v1.6H7.2z",
} as const;

export type IconName = keyof typeof PATHS;

export function Icon({ name }: { name: IconName }) {
  return (
    <svg class="icon-picture" viewBox="0 0 16 16" width="16" height="16" aria-hidden="true" focusable="false">
      <path d={PATHS[name]} />
    </svg>
  );
}
