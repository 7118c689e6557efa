// The numbers in brackets are the sections of protocol/README.md.
#define _POSIX_C_SOURCE 200809L
#include "tube_segments.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#define HEADER_BYTES 2048

// ---- processes [10]

// Reads state and start time of a process; false if there is no such process, or no /proc.
static bool process_stat(int64_t pid, char *state, int64_t *started)
{
    char path[64], text[1024];
    snprintf(path, sizeof path, "/proc/%" PRId64 "/stat", pid);
    const int descriptor = open(path, O_RDONLY | O_CLOEXEC);
    if (descriptor < 0)
        return false;
    const ssize_t length = read(descriptor, text, sizeof text - 1);
    close(descriptor);
    if (length <= 0)
        return false;
    text[length] = 0;
    const char *field = strrchr(text, ')'); // the name before it may hold spaces and brackets
    if (field == NULL || field[1] == 0)
        return false;
    field += 2; // field 3
    *state = *field;
    for (int i = 3; i < 22 && field != NULL; i++)
        field = strchr(field + 1, ' ');
    *started = field == NULL ? 0 : strtoll(field, NULL, 10);
    return true;
}

static bool is_alive(int64_t pid, int64_t started)
{
    char state;
    int64_t found;
    if (pid <= 0)
        return true; // not known
    if (process_stat(pid, &state, &found))
        return strchr("ZXx", state) == NULL && (started == 0 || started == found);
    return kill((pid_t)pid, 0) == 0 || errno == EPERM; // gone, or a system without /proc
}

int64_t tube_start_time(void)
{
    char state;
    int64_t started;
    return process_stat(getpid(), &state, &started) ? started : 0;
}

bool tube_agent_is_dead(const tube_segments *segments)
{
    const tube_command_segment *command = segments->command.memory;
    return __atomic_load_n(&command->magic, __ATOMIC_ACQUIRE) == TUBE_COMMAND_MAGIC &&
           !is_alive(command->pid, command->start_time);
}

// ---- one segment [2]

static void unmap(tube_segment *segment)
{
    if (segment->memory != NULL)
        munmap(segment->memory, (size_t)segment->bytes);
    if (segment->descriptor >= 0)
        close(segment->descriptor);
    segment->descriptor = -1;
    segment->memory = NULL;
}

// Opens and maps a segment; one without a size, whose creator is not so far, is open but has no memory.
static bool map(tube_segment *segment, int protection)
{
    struct stat file;
    segment->descriptor = open(segment->path, O_RDWR | O_CLOEXEC);
    if (segment->descriptor < 0 || fstat(segment->descriptor, &file) != 0)
        return false;
    segment->bytes = file.st_size;
    if (file.st_size == 0)
        return true;
    void *memory = mmap(NULL, (size_t)file.st_size, protection, MAP_SHARED, segment->descriptor, 0);
    segment->memory = memory == MAP_FAILED ? NULL : memory;
    return segment->memory != NULL;
}

static bool lock(const tube_segment *segment)
{
    struct flock byte_0 = {.l_type = F_WRLCK, .l_whence = SEEK_SET, .l_start = 0, .l_len = 1};
    return fcntl(segment->descriptor, F_SETLK, &byte_0) == 0;
}

// Whether the segment's name still stands for what we mapped.
static bool is_named(const tube_segment *segment)
{
    struct stat named, mapped;
    return stat(segment->path, &named) == 0 && fstat(segment->descriptor, &mapped) == 0 &&
           named.st_dev == mapped.st_dev && named.st_ino == mapped.st_ino;
}

// ---- both [2, 4]

bool tube_parse_rendezvous(tube_segments *segments, const char *rendezvous)
{
    const char *allowed = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-";
    const char *folder = "/dev/shm/", *stem = rendezvous + 4;
    segments->command.descriptor = segments->pose.descriptor = -1;
    if (strncmp(rendezvous, "shm:", 4) == 0) {
        const size_t length = strlen(stem);
        if (length < 1 || length > 64 || strspn(stem, allowed) != length || strchr("._-", *stem) != NULL)
            return false;
    } else if (strncmp(rendezvous, "file:/", 6) == 0 && strlen(rendezvous) < 4096) {
        folder = "";
        stem = rendezvous + 5;
    } else {
        return false;
    }
    snprintf(segments->command.path, sizeof segments->command.path, "%s%s.cmd", folder, stem);
    snprintf(segments->pose.path, sizeof segments->pose.path, "%s%s.pose", folder, stem);
    return true;
}

tube_look tube_look_for_session(tube_segments *segments, bool patient)
{
    tube_segment *command = &segments->command, *pose = &segments->pose;
    tube_close(segments); // of the look before
    if (!map(command, PROT_READ) || (command->bytes > 0 && command->bytes < HEADER_BYTES))
        return TUBE_LOOK_NOTHING;
    const tube_command_segment *header = command->memory;
    const int64_t magic = header == NULL ? 0 : __atomic_load_n(&header->magic, __ATOMIC_ACQUIRE);
    if (magic == 0 && patient)
        return TUBE_LOOK_UNFINISHED;
    if (magic == 0 || tube_agent_is_dead(segments)) {
        map(pose, PROT_READ);
        tube_remove_names(segments);
        return TUBE_LOOK_NOTHING;
    }
    const bool left = __atomic_load_n(&header->farewell, __ATOMIC_ACQUIRE) != TUBE_FAREWELL_NONE;
    if (magic == TUBE_COMMAND_MAGIC && left) // a foreign magic is left to the handshake, which names it
        return TUBE_LOOK_NOTHING;
    if (!map(pose, PROT_READ | PROT_WRITE) || !is_named(command)) // not so far, or just replaced by a new agent's
        return TUBE_LOOK_NOTHING;
    if (pose->bytes < HEADER_BYTES)
        return TUBE_LOOK_TOO_SHORT;
    const tube_pose_segment *served = pose->memory;
    if (!lock(pose) || __atomic_load_n(&served->magic, __ATOMIC_ACQUIRE) != 0 ||
        __atomic_load_n(&served->farewell, __ATOMIC_ACQUIRE) != TUBE_FAREWELL_NONE)
        return TUBE_LOOK_TAKEN;
    return TUBE_LOOK_CLAIMED;
}

bool tube_remove_names(const tube_segments *segments)
{
    // Under the lock of `.cmd` no newer name takes its place; `.pose` first: as long as `.cmd` has its name, no new
    // agent makes a `.pose`.
    const tube_segment *command = &segments->command, *pose = &segments->pose;
    if (!lock(command))
        return false;
    if (is_named(command)) {
        if (pose->descriptor >= 0 && is_named(pose))
            unlink(pose->path);
        unlink(command->path);
    }
    return true;
}

void tube_close(tube_segments *segments)
{
    unmap(&segments->command);
    unmap(&segments->pose);
}
