// What the physics side refuses, checked before anything is integrated. Part of tube_physics.c; an engine needs
// tube_physics.h alone. Each check returns TUBE_STATUS_DONE, or fills `why` in and returns TUBE_STATUS_REFUSED.
#ifndef TUBE_CHECKS_H
#define TUBE_CHECKS_H

#include <stdarg.h>
#include <stdbool.h>

#include "tube_physics.h"

// The tubes that are registered, one flag an index.
typedef struct tube_register {
    bool *taken;
    int64_t slots;
} tube_register;

int tube_check_command(tube_refusal *why, int64_t lane, const tube_command_row *row, double speed_max);
int tube_check_reset(tube_refusal *why, int64_t lane, const tube_reset_row *row, const tube_register *tubes);
int tube_check_registration(tube_refusal *why, const tube_command_segment *request, const tube_register *tubes);
// `lane_tube` has the index of the tube that each lane flies in.
int tube_check_release(tube_refusal *why, int64_t index, const tube_register *tubes, const int64_t *lane_tube,
                       int64_t lanes);

// First lane whose pose holds a number that is not finite; -1 if there is none.
int64_t tube_first_not_finite(const tube_pose_row *poses, int64_t lanes);

// Write a formatted text into a field padded with zeros, cut at a character where it is too long.
void tube_write_text(char *field, size_t room, const char *format, va_list arguments);
void tube_put_text(char *field, size_t room, const char *format, ...);

#endif
