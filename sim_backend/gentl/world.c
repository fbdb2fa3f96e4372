#include "world.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#ifndef MSG_NOSIGNAL /* macOS has a socket option instead */
#define MSG_NOSIGNAL 0
#endif

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "wire and buffers are written as they lie in memory");

static const char MAGIC[4] = {'M', 'F', 'S', '1'};
static const char PICTURE[4] = {'P', 'I', 'C', 'T'};

#pragma pack(push, 1)
struct hello {
    char magic[4];
    uint32_t channel;
    char serial[64];
};

struct picture_request {
    char magic[4];
    uint32_t bits;
    uint64_t id;
    int64_t begin_ns, duration_ns;
    uint32_t offset_x, offset_y, width, height;
    double gain_db, black_level_dn;
};

struct picture_answer {
    char magic[4];
    uint32_t status;
    uint64_t bytes;
};

struct exposed {
    uint64_t id;
    int64_t begin_ns, end_ns;
};
#pragma pack(pop)

static bool send_all(int socket, const void *data, size_t size) {
    const char *next = data;
    while (size > 0) {
        ssize_t sent = send(socket, next, size, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR)
            continue;
        if (sent <= 0)
            return false;
        next += sent;
        size -= (size_t)sent;
    }
    return true;
}

static bool receive_all(int socket, void *data, size_t size) {
    char *next = data;
    while (size > 0) {
        ssize_t got = recv(socket, next, size, 0);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            return false;
        next += got;
        size -= (size_t)got;
    }
    return true;
}

bool world_exists(void) {
    const char *path = getenv("MFS_SIM_WORLD");
    return path && *path;
}

int world_connect(const char *serial, enum world_channel channel) {
    const char *path = getenv("MFS_SIM_WORLD");
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof address.sun_path) {
        errno = path ? ENAMETOOLONG : ENOENT;
        return -1;
    }
    snprintf(address.sun_path, sizeof address.sun_path, "%s", path);
    int connection = socket(AF_UNIX, SOCK_STREAM, 0);
    if (connection < 0)
        return -1;
    fcntl(connection, F_SETFD, FD_CLOEXEC);
#ifdef SO_NOSIGPIPE
    setsockopt(connection, SOL_SOCKET, SO_NOSIGPIPE, &(int){1}, sizeof(int));
#endif
    struct hello hello = {.channel = channel};
    memcpy(hello.magic, MAGIC, sizeof MAGIC);
    snprintf(hello.serial, sizeof hello.serial, "%s", serial);
    if (connect(connection, (struct sockaddr *)&address, sizeof address) != 0 ||
        !send_all(connection, &hello, sizeof hello)) {
        int reason = errno;
        close(connection);
        errno = reason;
        return -1;
    }
    return connection;
}

bool world_picture(int socket, const struct exposure *exposure, void *raw, size_t size) {
    struct picture_request request = {
        .bits = picture_bits(exposure->format),
        .id = exposure->id,
        .begin_ns = exposure->begin_ns,
        .duration_ns = exposure->end_ns - exposure->begin_ns,
        .offset_x = exposure->offset_x,
        .offset_y = exposure->offset_y,
        .width = exposure->width,
        .height = exposure->height,
        .gain_db = exposure->gain_db,
        .black_level_dn = exposure->black_level_dn,
    };
    memcpy(request.magic, PICTURE, sizeof PICTURE);
    struct picture_answer answer;
    return send_all(socket, &request, sizeof request) && receive_all(socket, &answer, sizeof answer) &&
           memcmp(answer.magic, PICTURE, sizeof PICTURE) == 0 && answer.status == 0 && answer.bytes == size &&
           receive_all(socket, raw, size);
}

bool world_next_message(int socket, struct world_message *message) {
    return receive_all(socket, message, sizeof *message);
}

void world_exposed(int socket, const struct exposure *exposure) {
    struct exposed exposed = {exposure->id, exposure->begin_ns, exposure->end_ns};
    /* 24 bytes go into a stream socket's buffer whole or not at all: a world that does not listen misses them. */
    send(socket, &exposed, sizeof exposed, MSG_NOSIGNAL | MSG_DONTWAIT);
}
