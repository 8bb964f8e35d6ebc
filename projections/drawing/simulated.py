"""The plan of a simulated house, for the background of a picture."""

from eventsrc.sim import House

from .scene import Floor


def floor_of(house: House) -> Floor:
    """Walls, standing furniture and room names of ``house``."""
    standing = (thing.footprint for thing in house.things if thing.model.stands)
    return Floor(
        walls=tuple((wall.x0, wall.y0, wall.x1, wall.y1) for wall in house.plan.walls),
        furniture=tuple((rect.x0, rect.y0, rect.x1, rect.y1) for rect in standing),
        rooms=tuple(
            (room.name, (room.rect.x0, room.rect.y0, room.rect.x1, room.rect.y1))
            for room in house.plan.rooms
        ),
    )
