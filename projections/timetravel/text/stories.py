"""`mapfold why` for people: the summary first, then the chronicle."""

from projections.timetravel.story import Story


def story_text(story: Story) -> str:
    """The story, one entry a line: offset, time, what happened."""
    subject = story.subject if story.kind == "same" else f"{story.kind} {story.subject}"
    lines = [f"{subject}: {story.summary}"]
    width = max((len(f"{e.cause.offset:,}") for e in story.entries), default=1)
    for entry in story.entries:
        time = entry.cause.when
        lines.append(f"  {entry.cause.offset:>{width},}  {time}  {entry.text}")
    return "".join(f"{line}\n" for line in lines)
