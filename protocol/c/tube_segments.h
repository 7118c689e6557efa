// Finding the session that an agent offers: rendezvous, mapping, locks, liveness, removal of what the dead left.
// Part of tube_physics.c; an engine needs tube_physics.h alone.
#ifndef TUBE_SEGMENTS_H
#define TUBE_SEGMENTS_H

#include <stdbool.h>

#include "tube_cosim.h"

typedef struct tube_segment {
    char path[4104];
    int descriptor; // -1: not open
    int64_t bytes;
    void *memory; // NULL: not mapped
} tube_segment;

typedef struct tube_segments {
    tube_segment command, pose;
} tube_segments;

// What a look for a session found.
typedef enum tube_look {
    TUBE_LOOK_NOTHING, // nothing that could be attached to: look again
    TUBE_LOOK_UNFINISHED, // a header without its magic: look again, and lose patience with it after half a second
    TUBE_LOOK_CLAIMED, // both segments are mapped, the lock of `.pose` is ours
    TUBE_LOOK_TAKEN, // another physics process serves the session, or has served it
    TUBE_LOOK_TOO_SHORT, // `.pose` is shorter than a header
} tube_look;

// Sets the paths of both segments; false if the text is no rendezvous.
bool tube_parse_rendezvous(tube_segments *segments, const char *rendezvous);

// Looks once for a session, and removes the segments of a dead agent, or, without patience, an abandoned header.
// Whatever it found, the segments are to be closed in the end.
tube_look tube_look_for_session(tube_segments *segments, bool patient);

// Whether the agent's process is gone.
bool tube_agent_is_dead(const tube_segments *segments);

// Start of this process in the unit of the header's start_time; 0 where that is not known.
int64_t tube_start_time(void);

// Removes both names, unless they stand for newer segments by now; false while another process has the lock of
// `.cmd`, which a process that is just dead may have for a moment longer.
bool tube_remove_names(const tube_segments *segments);

// Unmaps both, which gives up the locks.
void tube_close(tube_segments *segments);

#endif
