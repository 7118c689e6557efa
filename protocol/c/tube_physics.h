// The physics side of a session for C and C++: tube_serve does everything that the specification asks of a
// physics process (opening, locks, handshake, waiting, checks, refusals, farewells, liveness) and calls a
// tube_plant for what is left: to integrate. Linux, and macOS by `file:`; GCC or Clang.
#ifndef TUBE_PHYSICS_H
#define TUBE_PHYSICS_H

#include <signal.h>
#include <stddef.h>

#include "tube_cosim.h"

#ifdef __cplusplus
extern "C" {
#endif

// What the agent asks of the session.
typedef struct tube_settings {
    int64_t lanes;
    double dt; // control step (s)
    double physics_dt; // inner step (s)
    int64_t inner_steps; // inner steps of a control step
    int64_t tube_slots;
} tube_settings;

// A tube as it is named by register_tube. The plant checks the file's hash and what it can read.
typedef struct tube_file {
    const char *path;
    int64_t axes; // TUBE_Z_UP or TUBE_Y_UP
    double scale; // metres per unit of the file
    const uint8_t *sha256; // 32 bytes
} tube_file;

// Why a request cannot be carried out, as it stands in the pose segment; or, with TUBE_FAILED, what went wrong.
typedef struct tube_refusal {
    int64_t code; // tube_refusal_code
    int64_t lane; // -1 where no lane is meant
    char field[112];
    char expected[384];
    char found[512];
} tube_refusal;

// Whatever integrates. Each function returns TUBE_STATUS_DONE; or what tube_refuse returns, and then no lane has
// moved; or what tube_fail returns, and then the session ends.
typedef struct tube_plant {
    const char *name, *version, *engine; // UTF-8; they are recorded with every run
    double speed_max; // largest speed that a command may carry (m/s)
    int64_t walls; // 1 if registered tubes stop the body and contact is reported
    tube_parameters defaults;
    void *self; // handed to every function

    // Prepares the worlds. Called once.
    int (*open)(void *self, const tube_settings *settings, tube_refusal *why);
    // Puts the lanes whose row is `selected` into the row's state. `poses`, one row a lane, has these states
    // already; an engine that rounds them writes them again.
    int (*reset)(void *self, const tube_reset_row *rows, tube_pose_row *poses, tube_refusal *why);
    // Integrates every lane over `inner_steps` inner steps and writes position, quaternion, velocities and
    // contact_steps of all poses. They hold the last state; their `step` and `sim_time` are already the new ones.
    int (*step)(void *self, const tube_command_row *rows, tube_pose_row *poses, tube_refusal *why);
    // Reads a tube's wall, forgets it. Both may be NULL where there are no walls: then any tube is taken.
    int (*register_tube)(void *self, int64_t index, const tube_file *tube, tube_refusal *why);
    int (*release_tube)(void *self, int64_t index, tube_refusal *why);
} tube_plant;

// How a session ended; up to 4 the numbers of the farewells.
typedef enum tube_ending {
    TUBE_END_GOODBYE = 0, // as it should
    TUBE_END_STOPPED = 1, // we were told to stop
    TUBE_END_FAILED = 2, // an error of our own
    TUBE_END_VIOLATION = 3, // the agent broke the protocol
    TUBE_END_HANDSHAKE = 4, // the agent's header is not acceptable
    TUBE_END_LOST = 5, // the agent died or left, or offered no session within 30 s
    TUBE_END_UNUSABLE = 6, // the rendezvous cannot be used, or another process serves the session
} tube_ending;

// Waits for the session that an agent offers at `rendezvous` (`shm:NAME` or `file:/path/stem`) and answers its
// requests until it ends. Ends soon after *stop has become other than 0; a signal's handler may set it. `message`,
// of `room` bytes, says how it ended.
tube_ending tube_serve(const char *rendezvous, const tube_plant *plant, const volatile sig_atomic_t *stop,
                       char *message, size_t room);

#define TUBE_FAILED (-1)

// Fills a refusal in (`found` is a format as printf's) and returns TUBE_STATUS_REFUSED.
int tube_refuse(tube_refusal *why, tube_refusal_code code, int64_t lane, const char *field, const char *expected,
                const char *found, ...);
// Says what went wrong (a format as printf's) and returns TUBE_FAILED.
int tube_fail(tube_refusal *why, const char *what, ...);

#ifdef __cplusplus
}
#endif

#endif
