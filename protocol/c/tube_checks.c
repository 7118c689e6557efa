// Section 7 of protocol/README.md: what is refused, and in which order the words of a row are looked at.
#include "tube_checks.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

static const struct {
    const char *name, *range;
    double lowest, highest;
    int whole;
} parameters[] = TUBE_PARAMETERS;

// ---- texts

void tube_write_text(char *field, size_t room, const char *format, va_list arguments)
{
    memset(field, 0, room);
    if (vsnprintf(field, room, format, arguments) < (int)room)
        return;
    size_t last = strlen(field) - 1;
    while (last > 0 && ((unsigned char)field[last] & 0xC0) == 0x80)
        field[last--] = 0;
    if ((unsigned char)field[last] >= 0x80)
        field[last] = 0;
}

void tube_put_text(char *field, size_t room, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    tube_write_text(field, room, format, arguments);
    va_end(arguments);
}

int tube_refuse(tube_refusal *why, tube_refusal_code code, int64_t lane, const char *field, const char *expected,
                const char *found, ...)
{
    va_list arguments;
    why->code = code;
    why->lane = lane;
    tube_put_text(why->field, sizeof why->field, "%s", field);
    tube_put_text(why->expected, sizeof why->expected, "%s", expected);
    va_start(arguments, found);
    tube_write_text(why->found, sizeof why->found, found, arguments);
    va_end(arguments);
    return TUBE_STATUS_REFUSED;
}

int tube_fail(tube_refusal *why, const char *what, ...)
{
    va_list arguments;
    va_start(arguments, what);
    tube_write_text(why->found, sizeof why->found, what, arguments);
    va_end(arguments);
    return TUBE_FAILED;
}

// ---- numbers: since done is 0 and refused 1, `a || b` is the first fault of both

static int check_range(tube_refusal *why, int64_t lane, const char *name, double value, double lowest, double highest,
                       const char *range)
{
    if (!isfinite(value))
        return tube_refuse(why, TUBE_REFUSAL_NOT_FINITE, lane, name, "a finite number", "%.17g", value);
    if (value < lowest || value > highest)
        return tube_refuse(why, TUBE_REFUSAL_OUT_OF_RANGE, lane, name, range, "%.17g", value);
    return TUBE_STATUS_DONE;
}

static int check_finite(tube_refusal *why, int64_t lane, const char *name, const double *values, int count)
{
    for (int i = 0; i < count; i++)
        if (check_range(why, lane, name, values[i], -DBL_MAX, DBL_MAX, "finite"))
            return TUBE_STATUS_REFUSED;
    return TUBE_STATUS_DONE;
}

static int check_unit(tube_refusal *why, int64_t lane, const char *name, const double *values, int count)
{
    double squared = 0.0;
    if (check_finite(why, lane, name, values, count))
        return TUBE_STATUS_REFUSED;
    for (int i = 0; i < count; i++)
        squared += values[i] * values[i];
    if (fabs(squared - 1.0) > TUBE_UNIT_TOLERANCE)
        return tube_refuse(why, TUBE_REFUSAL_NOT_UNIT, lane, name, "squared length 1 within 1e-6", "%.17g", squared);
    return TUBE_STATUS_DONE;
}

static int check_zero(tube_refusal *why, int64_t lane, const char *name, const void *words, size_t bytes)
{
    static const uint8_t zero[TUBE_RESET_STRIDE];
    if (memcmp(words, zero, bytes) != 0) // by bits: -0.0 is not zero here
        return tube_refuse(why, TUBE_REFUSAL_RESERVED, lane, name, "zero bits", "others");
    return TUBE_STATUS_DONE;
}

// ---- rows

int tube_check_command(tube_refusal *why, int64_t lane, const tube_command_row *row, double speed_max)
{
    return check_unit(why, lane, "direction", row->direction, 3) ||
           check_range(why, lane, "speed", row->speed, 0.0, speed_max, "0 to speed_max") ||
           check_range(why, lane, "compensation", row->compensation, 0.0, TUBE_COMPENSATION_MAX, "0 to 2") ||
           check_zero(why, lane, "reserved command words", row->reserved, sizeof row->reserved);
}

static int check_parameters(tube_refusal *why, int64_t lane, const tube_parameters *row)
{
    double values[TUBE_PARAMETER_SLOTS];
    memcpy(values, row, sizeof values);
    for (int i = 0; i < TUBE_PARAMETER_COUNT; i++) {
        const char *name = parameters[i].name, *range = parameters[i].range;
        if (check_range(why, lane, name, values[i], parameters[i].lowest, parameters[i].highest, range))
            return TUBE_STATUS_REFUSED;
        if (parameters[i].whole && values[i] != floor(values[i]))
            return tube_refuse(why, TUBE_REFUSAL_OUT_OF_RANGE, lane, name, range, "%.17g", values[i]);
    }
    return check_zero(why, lane, "reserved parameter words", row->reserved, sizeof row->reserved);
}

static bool is_registered(const tube_register *tubes, int64_t index)
{
    return index >= 0 && index < tubes->slots && tubes->taken[index];
}

int tube_check_reset(tube_refusal *why, int64_t lane, const tube_reset_row *row, const tube_register *tubes)
{
    if (row->selected == 0)
        return TUBE_STATUS_DONE;
    if (row->selected != 1)
        return tube_refuse(why, TUBE_REFUSAL_OUT_OF_RANGE, lane, "selected", "0 or 1", "%" PRId64, row->selected);
    if (check_finite(why, lane, "position", row->position, 3) ||
        check_finite(why, lane, "quaternion", row->quaternion, 4) ||
        check_finite(why, lane, "linear_velocity", row->linear_velocity, 3) ||
        check_finite(why, lane, "angular_velocity", row->angular_velocity, 3))
        return TUBE_STATUS_REFUSED;
    if (row->tube != TUBE_NO_TUBE && !is_registered(tubes, row->tube))
        return tube_refuse(why, TUBE_REFUSAL_UNKNOWN_TUBE, lane, "tube", "a registered tube's index, or -1",
                           "%" PRId64, row->tube);
    return check_unit(why, lane, "quaternion", row->quaternion, 4) || check_parameters(why, lane, &row->parameters);
}

int64_t tube_first_not_finite(const tube_pose_row *poses, int64_t lanes)
{
    for (int64_t lane = 0; lane < lanes; lane++) {
        double state[13]; // position, quaternion, velocities
        memcpy(state, &poses[lane], sizeof state);
        for (int i = 0; i < 13; i++)
            if (!isfinite(state[i]))
                return lane;
    }
    return -1;
}

// ---- tubes

// Whether bytes are UTF-8 (no character written too long, no half of a pair, none too high) without a zero byte.
static bool is_text(const char *bytes, int64_t length)
{
    const unsigned char *text = (const unsigned char *)bytes;
    for (int64_t i = 0; i < length;) {
        const unsigned char first = text[i++];
        const int more = first < 0x80 ? 0 : first < 0xE0 ? 1 : first < 0xF0 ? 2 : 3;
        unsigned char lowest = first == 0xE0 ? 0xA0 : first == 0xF0 ? 0x90 : 0x80;
        unsigned char highest = first == 0xED ? 0x9F : first == 0xF4 ? 0x8F : 0xBF;
        if (first == 0 || (first >= 0x80 && first < 0xC2) || first > 0xF4 || length - i < more)
            return false;
        for (int k = 0; k < more; k++, i++, lowest = 0x80, highest = 0xBF)
            if (text[i] < lowest || text[i] > highest)
                return false;
    }
    return true;
}

static int check_index(tube_refusal *why, int64_t index, const tube_register *tubes)
{
    if (index < 0 || index >= tubes->slots)
        return tube_refuse(why, TUBE_REFUSAL_TUBE_SLOT, -1, "tube_index", "0 to tube_slots - 1", "%" PRId64, index);
    return TUBE_STATUS_DONE;
}

int tube_check_registration(tube_refusal *why, const tube_command_segment *request, const tube_register *tubes)
{
    const int64_t index = request->tube_index, axes = request->tube_axes, length = request->tube_path_bytes;
    const double scale = request->tube_scale;
    if (check_index(why, index, tubes))
        return TUBE_STATUS_REFUSED;
    if (axes != TUBE_Z_UP && axes != TUBE_Y_UP)
        return tube_refuse(why, TUBE_REFUSAL_MALFORMED, -1, "tube_axes", "0 (Z up) or 1 (Y up)", "%" PRId64, axes);
    if (!isfinite(scale) || scale <= 0.0)
        return tube_refuse(why, TUBE_REFUSAL_OUT_OF_RANGE, -1, "tube_scale", "a factor > 0", "%.17g", scale);
    if (length < 1 || length > (int64_t)sizeof request->tube_path)
        return tube_refuse(why, TUBE_REFUSAL_MALFORMED, -1, "tube_path_bytes", "1 to 4096", "%" PRId64, length);
    if (!is_text(request->tube_path, length))
        return tube_refuse(why, TUBE_REFUSAL_MALFORMED, -1, "tube_path", "UTF-8 without zero bytes", "other bytes");
    if (tubes->taken[index])
        return tube_refuse(why, TUBE_REFUSAL_TUBE_SLOT, -1, "tube_index", "a free one", "%" PRId64 ", taken", index);
    return TUBE_STATUS_DONE;
}

int tube_check_release(tube_refusal *why, int64_t index, const tube_register *tubes, const int64_t *lane_tube,
                       int64_t lanes)
{
    if (check_index(why, index, tubes))
        return TUBE_STATUS_REFUSED;
    if (!tubes->taken[index])
        return tube_refuse(why, TUBE_REFUSAL_UNKNOWN_TUBE, -1, "tube_index", "one registered", "%" PRId64, index);
    for (int64_t lane = 0; lane < lanes; lane++)
        if (lane_tube[lane] == index)
            return tube_refuse(why, TUBE_REFUSAL_TUBE_IN_USE, lane, "tube_index", "a tube that no lane flies in",
                               "%" PRId64, index);
    return TUBE_STATUS_DONE;
}
